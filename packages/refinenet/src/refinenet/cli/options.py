"""What several commands' options have in common."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import click
from click.core import ParameterSource
from posecore import command_line

from refinenet.refiner import BASELINES, NETWORK

RESULT_FILES = ("--init", "--out", "--candidates")
"""Options whose files have a sidecar."""
FILE = click.Path(path_type=Path)
NEW_FILE = click.Path(path_type=Path, dir_okay=False)
method_option = click.option(
    "--method", type=click.Choice([NETWORK, *BASELINES]), default=NETWORK, help="What refines the poses."
)
checkpoint_option = click.option(
    "--checkpoint",
    type=FILE,
    metavar="FILE",
    help="Trained network (.safetensors), for --method network; makes `refine --method search` more exact.",
)
device_option = click.option(
    "--device", type=click.Choice(["auto", "cpu", "cuda"]), default="auto", help="Where the network runs."
)
threads_option = click.option(
    "--threads", type=click.IntRange(0), default=0, help="Torch threads; 0 leaves torch's choice."
)
workers_option = click.option(
    "--workers", type=click.IntRange(1), default=1,
    help="Processes that refine images side by side; several have one torch thread each if --threads does not say.",
)  # fmt: skip
iterations_option = click.option(
    "--iterations",
    type=click.IntRange(1),
    default=5,
    help="Most updates of a pose, fewer once one is small; without a network so many at each resolution or range.",
)
other_mesh_option = click.option(
    "--allow-other-mesh", is_flag=True, help="Take a mesh of the trained object's size that is not the trained one."
)
quiet_option = click.option("--quiet", is_flag=True, help="No progress line.")
verbose_option = command_line.verbose_option("refinenet")


def require_apart(read: Mapping[str, Path | None], written: Mapping[str, Path | None]) -> None:
    """Refuse an output that is an input, or another output; both by the names of their options.

    Result files have a sidecar beside them, which counts as well.
    """
    known: dict[Path, str] = {}
    for name, path, is_new in (*((*one, False) for one in read.items()), *((*one, True) for one in written.items())):
        for what, file in () if path is None else _with_sidecar(name, path):
            other = known.setdefault(file.resolve(), what)
            if other != what and is_new:
                raise click.UsageError(f"{what} and {other} are both {file}: name two files")


def _with_sidecar(name: str, path: Path) -> list[tuple[str, Path]]:
    beside = [(f"the sidecar of {name}", path.with_name(f"{path.name}.json"))] if name in RESULT_FILES else []
    return [(name, path), *beside]


def require_used(why: str, *names: str) -> None:
    """Refuse options of this command that were given and do nothing, and say why: `without ...`, `with ...`."""
    context = click.get_current_context()
    for option in context.command.params:
        given = context.get_parameter_source(str(option.name)) is ParameterSource.COMMANDLINE
        if option.name in names and given:
            raise click.UsageError(f"{option.opts[-1]} does nothing {why}: leave it out")


def require_fit(method: str, checkpoint: Path | None, with_network: Sequence[str] = ()) -> None:
    """Refuse a network without a checkpoint, and a baseline with one that is not among `with_network`.

    Also options of a network where there is none.
    """
    if (checkpoint is None) == (method == NETWORK) and method not in with_network:
        needs = "needs a --checkpoint" if checkpoint is None else "takes no --checkpoint"
        raise click.UsageError(f"--method {method} {needs}")
    if checkpoint is None:
        require_used(f"for --method {method} without a network", "device", "batch", "allow_other_mesh")
