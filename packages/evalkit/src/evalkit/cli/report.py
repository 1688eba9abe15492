"""`evalkit report`."""

import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Literal

import click
from posecore.command_line import progress_bar

from evalkit.cli.options import FOLDER, split_option, verbose_option, vss_option, workers_option


@click.command()
@click.option("--dataset", type=FOLDER, help="BOP dataset folder. Default: the one the results' sidecars name.")
@click.option(
    "--results", multiple=True, type=FOLDER, help="BOP result file; repeat it to compare. Default: all with a sidecar."
)
@click.option("--out", type=FOLDER, default=Path("report"), help="Folder for the report.")
@split_option
@vss_option
@workers_option
@click.option(
    "--worst", type=click.IntRange(0, 200), default=12, help="Worst cases with pictures; 0 leaves out all pictures."
)
@verbose_option
def report(
    dataset: Path | None,
    results: tuple[Path, ...],
    out: Path,
    split: str | None,
    vss: Literal["full", "visible"],
    workers: int,
    worst: int,
) -> None:
    """Write a report: HTML page, tables for papers, CSV with a line for each pose, JSON summary.

    Without options, the result files are those with a sidecar (*.csv.json) in this folder and in results/, and the
    dataset is the one that the sidecars name. The report folder holds index.html (one file, readable offline),
    tables.md, tables.tex, estimates.csv and summary.json.

    \b
    Examples:
      evalkit report
      evalkit report --dataset lmo --results initial.csv --results refined.csv --out report
    """
    from evalkit.report.job import ReportJob, make_report

    job = ReportJob(out=out, results=results, dataset=dataset, split=split, vss=vss, worst=worst, workers=workers)
    with progress_bar(quiet=not sys.stderr.isatty()) as progress:

        def on_file(name: str, total: int) -> Callable[[int], None]:
            task = progress.add_task(name, total=total)
            return lambda done: progress.advance(task, done)

        made = make_report(job, on_file)
    for item in made.summary["against_initial"]:
        for line in _change_lines(item):
            click.echo(line)
    for file in made.summary["files"]:
        click.echo(_total_line(file))
    click.echo(f"Report: {made.page}")


def _change_lines(compared: dict[str, Any]) -> Iterator[str]:
    """The change of a file in lines: headline, verdict, then a line for each score."""
    from evalkit.report.comparison import interval_words

    yield compared["headline"]
    if compared["verdict"]:
        yield f"  {compared['verdict']}"
    yield from (f"  {change}" for change in compared["changes"])
    if compared["changes"]:
        yield f"  {interval_words(compared)}"


def _total_line(file: dict[str, Any]) -> str:
    total = file["total"]
    missing = f", {total['missing']} missing" if total["missing"] else ""
    return (
        f"{file['name']}: {total['expected']} poses{missing}, VSS {total['vss_mean']:.3f}, "
        f"ADD(-S) at 0.1 diameter {100 * total['add_s_recall_0.1d']:.1f} %"
    )
