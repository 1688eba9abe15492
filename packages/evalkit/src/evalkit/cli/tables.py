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
    help="Group with a row of its own, counted once in totals.",
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
    """Print the tables of the 2018 paper: initial poses, refined poses, several methods.

    Rotation and translation errors and ADD recall, VSS of every object, each object before and after, losses side by
    side; for initial poses perturbed by steps the curves. Totals are means over objects, as in the paper. Names of
    methods are `method` and `loss` of the sidecars.

    \b
    Examples:
      evalkit tables --results initial.csv --results contour.csv --results mse.csv --by scene
      evalkit tables --out tables.tex --out tables.csv --resamples 1000
    """
    from evalkit.tables.paper import PaperTablesJob, make_paper_tables
    from evalkit.tables.writers import text_of

    job = PaperTablesJob(
        results=results, dataset=dataset, split=split, by=by, vss=vss, workers=workers, resamples=resamples, out=out
    )
    made, written = make_paper_tables(job)
    click.echo(text_of(made, ".md"), nl=False)
    for path in written:
        click.echo(f"Table: {path}")
