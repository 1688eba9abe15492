"""`evalkit report`."""

import sys
from collections.abc import Callable
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
@click.option("--worst", type=click.IntRange(0, 200), default=12, help="Pictures of worst cases.")
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
    """Write a report: one HTML page, its tables for papers, a CSV line for each pose, a JSON summary.

    Without options, it takes the result files (*.csv with *.csv.json beside it) in this folder and in results/, and
    the dataset that their sidecars name. The folder then holds index.html (everything, in one file that opens
    offline), tables.md and tables.tex, estimates.csv and summary.json.

    \b
    Examples:
      evalkit report
      evalkit report --dataset lmo --results start.csv --results refined.csv --out report
    """
    from posecore.bop import BopDataset

    from evalkit.inputs.result_files import dataset_of, find_result_files
    from evalkit.report.write import write_report

    here = Path()
    paths = list(results) or find_result_files(here, dataset is not None)
    opened = BopDataset(dataset or dataset_of(paths, here), split)
    with progress_bar(quiet=not sys.stderr.isatty()) as progress:

        def start(name: str, total: int) -> Callable[[int], None]:
            task = progress.add_task(name, total=total)
            return lambda done: progress.advance(task, done)

        written = write_report(opened, paths, out, vss=vss, worst=worst, workers=workers, start=start)
    for item in written.summary["against_start"]:
        click.echo(item["words"])
    for file in written.summary["files"]:
        click.echo(_total_line(file))
    click.echo(f"Report: {written.page}")


def _total_line(file: dict[str, Any]) -> str:
    total = file["total"]
    missing = f", {total['missing']} missing" if total["missing"] else ""
    return (
        f"{file['name']}: {total['expected']} poses{missing}, VSS {total['vss_mean']:.3f}, "
        f"ADD(-S) at 0.1 diameter {100 * total['add_s_recall_0.1d']:.1f} %"
    )
