"""`synthgen verify`."""

import sys
from pathlib import Path

import click
from posecore.command_line import progress_bar

from synthgen.cli.options import QUIET


@click.command()
@click.argument("shards", type=str)
@click.option(
    "--samples",
    type=click.IntRange(0),
    default=5000,
    help="Samples to re-render and compare, chosen at random; all other checks cover every sample.",
)
@click.option("--seed", type=click.IntRange(0), default=0, help="Seed of the choice of re-rendered samples.")
@click.option("--allow-incomplete", is_flag=True, help="Accept missing shards: the dataset is still growing.")
@click.option(
    "--report",
    "page",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="Write a page with findings and coverage, .html.",
)
@click.option(
    "--json", "json_file", type=click.Path(path_type=Path), metavar="FILE", help="Write the findings as JSON."
)
@click.option(
    "--workers", type=click.IntRange(1), help="Processes; findings do not depend on it. [one per core, at most 8]"
)
@QUIET
def verify(
    shards: str,
    samples: int,
    seed: int,
    allow_incomplete: bool,
    page: Path | None,
    json_file: Path | None,
    workers: int | None,
    quiet: bool,
) -> None:
    """Check that a dataset is complete and that its samples agree with its data card.

    Every shard is read and compared with its checksum; poses, cameras, windows, masks, contours, distance transforms
    and patches are checked, and the meshes are rendered again at both poses. Exit code 0: every check passes; 1: a
    check fails; 2: wrong usage.

    \b
    synthgen verify shards
    synthgen verify shards --report verify.html --json verify.json
    synthgen verify s3://bucket/shards --samples 500 --allow-incomplete
    """
    from posecore.files import write_atomic
    from posecore.shard import ShardReader

    from synthgen.machine import cores
    from synthgen.verify.page import report_page
    from synthgen.verify.verify import verify as run

    reader = ShardReader(shards)
    with progress_bar(quiet) as bar:
        task = bar.add_task("samples", total=sum(map(reader.n_samples, reader.committed)))
        report = run(
            shards,
            samples=samples,
            seed=seed,
            allow_incomplete=allow_incomplete,
            workers=workers or min(8, cores()),
            on_shard=lambda n: bar.advance(task, n),
        )
    click.echo(report.text)
    if json_file is not None:
        write_atomic(json_file, report.as_json().encode())
    if page is not None:
        write_atomic(page, report_page(report).encode())
        click.echo(f"{page}: the report", err=True)
    if report.failed:
        click.echo(f"Error: {shards}: {len(report.failed)} checks fail: {', '.join(report.failed)}", err=True)
        sys.exit(1)
