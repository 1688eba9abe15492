"""Option types and checks that commands share."""

from collections.abc import Mapping
from pathlib import Path
from typing import get_args

import click
from click.core import ParameterSource
from posecore import command_line

from refinenet.config import DeviceName
from refinenet.refine.registry import METHODS, NETWORK, MethodSettings

RESULT_FILES = ("--init", "--out", "--candidates")
"""Options whose files have a sidecar."""
FILE = click.Path(path_type=Path)
NEW_FILE = click.Path(path_type=Path, dir_okay=False)
method_option = click.option("--method", type=click.Choice(METHODS), default=NETWORK, help="Refinement method.")
checkpoint_option = click.option(
    "--checkpoint",
    type=FILE,
    metavar="FILE",
    help="Trained network (.safetensors), for --method network; makes `refine --method search` more accurate.",
)
device_option = click.option(
    "--device", type=click.Choice(get_args(DeviceName)), default="auto", help="Device of the network."
)
threads_option = click.option(
    "--threads", type=click.IntRange(0), default=0, help="Torch threads; 0 leaves torch's choice."
)
workers_option = click.option(
    "--workers", type=click.IntRange(1), default=1,
    help="Processes that refine images in parallel; without --threads each of several has one torch thread.",
)  # fmt: skip
iterations_option = click.option(
    "--iterations",
    type=click.IntRange(1),
    default=5,
    help="Largest number of updates of a pose, fewer once an update is small; of a baseline, at each resolution or "
    "search range.",
)
other_mesh_option = click.option(
    "--allow-other-mesh", is_flag=True, help="Accept a mesh of the trained object's size that is not the trained one."
)
quiet_option = click.option("--quiet", is_flag=True, help="No progress line.")
verbose_option = command_line.verbose_option("refinenet")


def require_distinct_files(inputs: Mapping[str, Path | None], outputs: Mapping[str, Path | None]) -> None:
    """Refuse an output that is also an input or another output, sidecars included; keys are option names."""
    option_of: dict[Path, str] = {}
    for options, are_outputs in ((inputs, False), (outputs, True)):
        for name, path in options.items():
            for option, file in () if path is None else _with_sidecar(name, path):
                other = option_of.setdefault(file.resolve(), option)
                if other != option and are_outputs:
                    raise click.UsageError(f"{option} and {other} are both {file}: name two files")


def _with_sidecar(name: str, path: Path) -> list[tuple[str, Path]]:
    sidecar = [(f"the sidecar of {name}", path.with_name(f"{path.name}.json"))] if name in RESULT_FILES else []
    return [(name, path), *sidecar]


def require_used(why: str, *names: str) -> None:
    """Refuse options on the command line that have no effect, with the reason: `without ...`, `with ...`."""
    context = click.get_current_context()
    for option in context.command.params:
        is_set = context.get_parameter_source(str(option.name)) is ParameterSource.COMMANDLINE
        if option.name in names and is_set:
            raise click.UsageError(f"{option.opts[-1]} has no effect {why}; leave it out")


def refuse_unused_network_options(settings: MethodSettings) -> None:
    """Refuse options of a network for a method without one."""
    if settings.checkpoint is None:
        require_used(f"for --method {settings.method} without a network", "device", "batch", "allow_other_mesh")
