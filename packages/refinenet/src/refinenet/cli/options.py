"""What several commands' options have in common."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import click
from click.core import ParameterSource

from refinenet.methods import BASELINES, NETWORK

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
    "--iterations", type=click.IntRange(1), default=5, help="Most updates of a pose; fewer once one is small."
)
other_mesh_option = click.option(
    "--allow-other-mesh", is_flag=True, help="Take a mesh of the trained object's size that is not the trained one."
)
quiet_option = click.option("--quiet", is_flag=True, help="No progress line.")
verbose_option = click.option("--verbose", is_flag=True, help="Log details to stderr.")


def require_apart(read: Mapping[str, Path | None], written: Mapping[str, Path | None]) -> None:
    """Refuse an output that is an input, or another output; both by the names of their options."""
    known = {path.resolve(): name for name, path in read.items() if path is not None}
    for name, path in written.items():
        if path is None:
            continue
        other = known.setdefault(path.resolve(), name)
        if other != name:
            raise click.UsageError(f"{name} and {other} are both {path}: name two files")


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
