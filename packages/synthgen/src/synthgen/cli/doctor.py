"""`synthgen doctor`."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING

import click

from synthgen.cli.options import ENGINES

if TYPE_CHECKING:
    from posecore.mesh import Units


@click.command()
@click.option("--n", type=click.IntRange(1), default=200_000, help="Number of training pairs to plan for.")
@click.option(
    "--engine",
    "engines",
    multiple=True,
    type=click.Choice(ENGINES),
    help="Renderer to measure, and what must work. Repeatable. [all that work; eevee only on a GPU]",
)
@click.option(
    "--seconds", type=click.FloatRange(0), default=30.0, help="Time to measure, shared by the engines; 0: none."
)
@click.option(
    "--object", "mesh", type=click.Path(path_type=Path), metavar="MESH", help="Object to measure with. [a simple one]"
)
@click.option("--units", type=click.Choice(["mm", "cm", "m"]), default="mm", help="Unit of the mesh's coordinates.")
@click.option("--preset", default="default", metavar="NAME|FILE", help="Preset to measure with.")
@click.option(
    "--set",
    "overrides",
    multiple=True,
    metavar="KEY=VALUE",
    help="Change one configuration key. Repeatable; last wins.",
)
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    default=Path(),
    metavar="DIR",
    help="Where the dataset would go, for its disk.",
)
@click.option("--json", "as_json", is_flag=True, help="One JSON object instead of a table.")
def doctor(
    n: int,
    engines: tuple[str, ...],
    seconds: float,
    mesh: Path | None,
    units: "Units",
    preset: str,
    overrides: tuple[str, ...],
    out: Path,
    as_json: bool,
) -> None:
    """Say what this machine has of what rendering needs, and how long N pairs will take here.

    Looks at Blender, GL, GPUs, cores, memory and disk, then runs the real command with its default workers for half a
    minute into a temporary folder. Exit code 1 when something that is needed is missing.

    \b
    synthgen doctor
    synthgen doctor --n 50000 --object mesh.ply --preset quickstart --engine cycles --out shards
    synthgen doctor --seconds 0 --json
    """
    from posecore.mesh import load_mesh

    from synthgen.config import load_config
    from synthgen.inspect import doctor as doctoring
    from synthgen.inspect.speed import measure

    config = load_config(preset, overrides)
    if mesh is not None:
        load_mesh(mesh, units=units)
    found, able = doctoring.look(out, engines)
    chosen = tuple(name for name in (engines or able.worth_measuring()) if name in able.names) if seconds else ()
    arguments = ["--preset", preset, *(word for key in overrides for word in ("--set", key))]
    speeds = []
    for engine in chosen:
        click.echo(f"measuring {engine} for {seconds / len(chosen):.0f} s ...", err=True)
        speeds.append(measure(engine, config, arguments, seconds / len(chosen), mesh, units))
    found += doctoring.disk_found(speeds, n, out)
    click.echo((doctoring.as_json if as_json else doctoring.as_text)(found, speeds, n))
    missing = [item.name for item in found if item.state == "missing"] + [s.engine for s in speeds if not s.pairs]
    if missing:
        click.echo(f"Error: missing here: {', '.join(missing)}", err=True)
        sys.exit(1)
