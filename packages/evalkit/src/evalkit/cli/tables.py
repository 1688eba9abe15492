"""`evalkit tables`."""

from pathlib import Path
from typing import Literal

import click

from evalkit.cli.options import FOLDER, NEW_FILE, split_option, verbose_option, vss_option, workers_option


@click.command()
@click.option("--dataset", type=FOLDER, help="BOP dataset folder. Default: the one the results' sidecars name.")
@click.option(
    "--results", multiple=True, type=FOLDER, help="BOP result file; repeat it to compare. Default: all with a sidecar."
)
@split_option
@click.option(
    "--by",
    type=click.Choice(["object", "scene"]),
    default="object",
    help="What has a row of its own and is counted once in totals.",
)
@vss_option
@workers_option
@click.option("--resamples", type=click.IntRange(0), default=0, help="For 95 % intervals; 1000 are enough.")
@click.option("--out", multiple=True, type=NEW_FILE, help="Also write a file: .md, .tex, .csv or .json. Repeatable.")
@verbose_option
def tables(
    dataset: Path | None,
    results: tuple[Path, ...],
    split: str | None,
    by: Literal["object", "scene"],
    vss: Literal["full", "visible"],
    workers: int,
    resamples: int,
    out: tuple[Path, ...],
) -> None:
    """Print the tables of the 2018 paper for these result files: start poses, refined ones, several methods.

    Rotation and translation errors and ADD recall, VSS of every object, each object before and after, losses side by
    side; for starts perturbed by steps the curves. Totals are means over objects, as in the paper. Methods are named
    by `method` and `loss` in the sidecars.

    \b
    Examples:
      evalkit tables --results start.csv --results contour.csv --results mse.csv --by scene
      evalkit tables --out tables.tex --out tables.csv --resamples 1000
    """
    from posecore.bop import BopDataset

    from evalkit.inputs.result_files import dataset_of, find_result_files
    from evalkit.tables.model import require_suffixes, text_of, write_tables
    from evalkit.tables.paper import paper_tables, score_files

    require_suffixes(out)
    here = Path()
    paths = list(results) or find_result_files(here, dataset is not None)
    opened = BopDataset(dataset or dataset_of(paths, here), split)
    found = paper_tables(score_files(opened, paths, vss, workers=workers), by=by, resamples=resamples)
    click.echo(text_of(found, ".md"), nl=False)
    for path in out:
        for written in write_tables(path, found):
            click.echo(f"Table: {written}")
