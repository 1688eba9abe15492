"""`synthgen doctor`."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING

import click

from synthgen.cli.options import ENGINE, UNITS

if TYPE_CHECKING:
    from posecore.mesh import Units

    from synthgen.names import EngineName


@click.command()
@click.option("--n", type=click.IntRange(1), default=200_000, help="Number of training pairs to plan for.")
@click.option(
    "--engine",
    "engines",
    multiple=True,
    type=ENGINE,
    help="Renderer that must work and is measured. Repeatable. [every one that works; eevee only on a GPU]",
)
@click.option(
    "--seconds", type=click.FloatRange(0), default=30.0, help="Measuring time, divided between the engines; 0: none."
)
@click.option(
    "--object", "mesh", type=click.Path(path_type=Path), metavar="MESH", help="Object to measure with. [a simple one]"
)
@click.option("--units", type=UNITS, default="mm", help="Unit of the mesh's coordinates.")
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
    help="Folder of the planned dataset, for its disk.",
)
@click.option("--json", "as_json", is_flag=True, help="One JSON object instead of a table.")
def doctor(
    n: int,
    engines: "tuple[EngineName, ...]",
    seconds: float,
    mesh: Path | None,
    units: "Units",
    preset: str,
    overrides: tuple[str, ...],
    out: Path,
    as_json: bool,
) -> None:
    """Check this machine for rendering, and measure how long N pairs will take here.

    Checks Blender, GL, GPUs, cores, memory and disk, then renders with the default workers for half a minute into a
    temporary folder. Exit code 1 when a requirement is missing.

    \b
    synthgen doctor
    synthgen doctor --n 50000 --object mesh.ply --preset quickstart --engine cycles --out shards
    synthgen doctor --seconds 0 --json
    """
    from synthgen.config import load_config
    from synthgen.inspect.doctor import DoctorJob, diagnose

    config = load_config(preset, overrides)
    job = DoctorJob(config=config, n=n, engines=engines, seconds=seconds, mesh=mesh, units=units, out=out)
    report = diagnose(job, lambda engine, time_s: click.echo(f"measuring {engine} for {time_s:.0f} s ...", err=True))
    click.echo(report.as_json() if as_json else report.as_text())
    if report.missing:
        click.echo(f"Error: missing here: {', '.join(report.missing)}", err=True)
        sys.exit(1)
