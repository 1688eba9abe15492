"""`evalkit diff`."""

from pathlib import Path
from typing import Literal

import click

from evalkit.cli.options import FOLDER, NEW_FILE, split_option, verbose_option, vss_option, workers_option

RESULTS = click.Path(path_type=Path, dir_okay=False)


@click.command()
@click.argument("a", type=RESULTS)
@click.argument("b", type=RESULTS)
@click.option("--dataset", type=FOLDER, help="BOP dataset folder. Default: the one the files' sidecars name.")
@split_option
@vss_option
@workers_option
@click.option(
    "--limit",
    type=click.FloatRange(0, min_open=True),
    default=0.1,
    help="Smallest ADD(-S) of a failed pose, diameters.",
)
@click.option(
    "--fail-if", "rules", multiple=True, metavar="RULE", help="Exit with code 1 if the rule holds. Repeatable."
)
@click.option("--result-a", metavar="NAME", help="Name of the result file in A, if A is the estimates.csv of several.")
@click.option("--result-b", metavar="NAME", help="The same for B.")
@click.option("--json", "json_file", type=NEW_FILE, help="Write the comparison as JSON.")
@click.option("--csv", "csv_file", type=NEW_FILE, help="Write a line for each pose.")
@click.option("--html", "html_file", type=NEW_FILE, help="Write a page with pictures.")
@click.option("--list", "listed", type=click.IntRange(0), default=10, help="Poses to list of each kind.")
@click.option("--pictures", type=click.IntRange(0, 200), default=12, help="Pictures of each kind.")
@click.option("--resamples", type=click.IntRange(1), default=1000, help="Number of bootstrap resamples.")
@click.option("--seed", type=click.IntRange(0), default=0, help="Random seed of the bootstrap.")
@verbose_option
def diff(
    a: Path,
    b: Path,
    dataset: Path | None,
    split: str | None,
    vss: Literal["full", "visible"],
    workers: int,
    limit: float,
    rules: tuple[str, ...],
    result_a: str | None,
    result_b: str | None,
    json_file: Path | None,
    csv_file: Path | None,
    html_file: Path | None,
    listed: int,
    pictures: int,
    resamples: int,
    seed: int,
) -> None:
    """Compare result file B with A, pose by pose: deltas with 95 % intervals, newly failed and solved ones.

    A and B are BOP result files, or error tables (estimates.csv) of `evalkit report`, which need no dataset.

    \b
    Examples:
      evalkit diff old.csv new.csv --dataset lmo --html diff.html
      evalkit diff old.csv new.csv --fail-if "vss < -0.01" --fail-if "lower(recall) < -0.02"
      evalkit diff report/estimates.csv report/estimates.csv --result-a initial --result-b refined

    \b
    Rules of --fail-if:
      NAME OPERATOR NUMBER                compares the mean delta, B minus A
      STATISTIC(NAME) OPERATOR NUMBER     mean, median, lower or upper (end of the 95 % interval of the mean)
      fractions                           vss, recall, auc, ar_mssd, ar_mspd
      errors, mm                          add, adi, add_s, mssd, te, tx, ty, tz
      errors, px and deg                  mspd, proj; re, re_sym
      numbers of poses                    newly_failed, newly_solved, lost, gained, unpaired
      operators                           < <= > >=
    """
    from evalkit.diff import DiffJob, compare_files, parse_rule

    compared = compare_files(
        DiffJob(
            paths=(a, b),
            results=(result_a, result_b),
            dataset=dataset,
            split=split,
            vss=vss,
            workers=workers,
            limit_diameters=limit,
            resamples=resamples,
            seed=seed,
            rules=tuple(map(parse_rule, rules)),
            listed=listed,
            pictures=pictures,
            json_file=json_file,
            csv_file=csv_file,
            html_file=html_file,
        )
    )
    click.echo(compared.text)
    for file in compared.written:
        click.echo(f"Written: {file}")
    for verdict in compared.verdicts:
        click.echo(f"{'FAILED' if verdict.fired else 'passed'}: {verdict.words}", err=verdict.fired)
    if any(verdict.fired for verdict in compared.verdicts):
        raise click.exceptions.Exit(1)
