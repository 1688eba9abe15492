"""`synthgen verify`."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING

import click
from posecore.command_line import progress_bar

if TYPE_CHECKING:
    from synthgen.verify.findings import Finding, Report


@click.command()
@click.argument("shards", type=str)
@click.option(
    "--samples",
    type=click.IntRange(0),
    default=5000,
    help="Samples to draw again and compare, chosen at random; every sample is read and checked for the rest.",
)
@click.option("--seed", type=click.IntRange(0), default=0, help="Decides which samples are drawn again.")
@click.option("--allow-incomplete", is_flag=True, help="Missing shards are no failure: the dataset is still growing.")
@click.option("--report", type=click.Path(path_type=Path), metavar="FILE", help="Write a page with coverage, .html.")
@click.option("--json", "json_file", type=click.Path(path_type=Path), metavar="FILE", help="Write the findings.")
@click.option(
    "--workers", type=click.IntRange(1), help="Processes; findings do not depend on it. [one per core, at most 8]"
)
@click.option("--quiet", is_flag=True, help="No progress bar.")
def verify(
    shards: str,
    samples: int,
    seed: int,
    allow_incomplete: bool,
    report: Path | None,
    json_file: Path | None,
    workers: int | None,
    quiet: bool,
) -> None:
    """Check that a dataset is complete and that its samples are what its data card says.

    Every shard is read and held against its checksum; poses, cameras, windows, masks, contours, distance transforms
    and patches are checked, and the meshes are drawn again at both poses. Exit code 0: every check passes; 1: one
    fails; 2: wrong usage.

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
        found = run(
            shards,
            samples=samples,
            seed=seed,
            allow_incomplete=allow_incomplete,
            workers=workers or min(8, cores()),
            on_shard=lambda n: bar.advance(task, n),
        )
    for finding in found.findings:
        click.echo(_line(finding))
    click.echo(_covered(found))
    if json_file is not None:
        write_atomic(json_file, found.as_json().encode())
    if report is not None:
        write_atomic(report, report_page(found).encode())
        click.echo(f"{report}: the report", err=True)
    failed = [finding.name for finding in found.findings if not finding.ok]
    if failed:
        click.echo(f"Error: {shards}: {len(failed)} checks fail: {', '.join(failed)}", err=True)
        sys.exit(1)


def _line(finding: "Finding") -> str:
    mark = "ok  " if finding.ok else "FAIL"
    text = f"{mark} {finding.name:<28} {finding.covered - finding.failed:>7} of {finding.covered} {finding.of}"
    if finding.ok:
        worst = "" if finding.worst is None else f"worst {finding.worst:.3g}, "
        return f"{text:<60} {worst}tolerance {finding.tolerance}" if finding.tolerance else text
    where = f"not in {finding.of} {', '.join(map(str, finding.first))}" + (", ..." if finding.failed > 10 else "")
    worst = "" if finding.worst is None else f"; worst {finding.worst:.3g} in {finding.worst_index}"
    tolerance = f", tolerance {finding.tolerance}" if finding.tolerance else ""
    note = f"; {finding.note}" if finding.note else ""
    return f"{text}: {where}{worst}{tolerance}{note}"


def _covered(report: "Report") -> str:
    said = f"{report.committed} of {report.card['n']} samples are there and were read"
    return f"{said}, {report.drawn} of them drawn again with {report.gl}" if report.drawn else said
