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
    help="A pose fails with an ADD(-S) of so many diameters or more.",
)
@click.option(
    "--fail-if", "rules", multiple=True, metavar="RULE", help="End with exit code 1 if this is so; may be repeated."
)
@click.option("--result-a", metavar="NAME", help="Result file meant in A, where A is the estimates.csv of several.")
@click.option("--result-b", metavar="NAME", help="The same for B.")
@click.option("--json", "json_file", type=NEW_FILE, help="Write everything as JSON.")
@click.option("--csv", "csv_file", type=NEW_FILE, help="Write a line for each pose.")
@click.option("--html", "html_file", type=NEW_FILE, help="Write a page with pictures.")
@click.option("--list", "listed", type=click.IntRange(0), default=10, help="Poses to list.")
@click.option("--pictures", type=click.IntRange(0, 200), default=12, help="Pictures of each kind.")
@click.option("--resamples", type=click.IntRange(1), default=1000, help="Of the bootstrap.")
@click.option("--seed", type=click.IntRange(0), default=0, help="Of the bootstrap.")
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
    """Compare result file B with A, pose by pose: deltas with 95 % intervals, what newly fails, what is newly solved.

    A and B are BOP result files, or tables of errors (estimates.csv) that `evalkit report` wrote, which need no
    dataset.

    \b
    Examples:
      evalkit diff old.csv new.csv --dataset lmo --html diff.html
      evalkit diff old.csv new.csv --fail-if "vss < -0.01" --fail-if "lower(recall) < -0.02"
      evalkit diff report/estimates.csv report/estimates.csv --result-a start --result-b refined

    \b
    Rules of --fail-if:
      NAME OPERATOR NUMBER                compares the mean delta, B minus A
      STATISTIC(NAME) OPERATOR NUMBER     mean, median, lower or upper (end of the 95 % interval of the mean)
      shares, as fractions                vss, recall, auc, ar_mssd, ar_mspd
      errors, mm                          add, adi, add_s, mssd, te, tx, ty, tz
      errors, px and deg                  mspd, proj; re, re_sym
      numbers of poses                    newly_failed, newly_solved, lost, gained, unpaired
      operators                           < <= > >=
    """
    from posecore.files import write_atomic

    from evalkit.diff import differences, judge, open_sides, parse_rule
    from evalkit.diff.text import csv_text, json_text, text

    parsed = [parse_rule(rule) for rule in rules]
    named = (result_a, result_b)
    with open_sides((a, b), results=named, dataset=dataset, split=split, vss=vss, workers=workers) as sides:
        difference = differences(sides, limit_diameters=limit, resamples=resamples, seed=seed)
        verdicts = judge(parsed, difference)
        click.echo(text(difference, listed))
        if json_file:
            write_atomic(json_file, json_text(difference, verdicts).encode())
        if csv_file:
            write_atomic(csv_file, csv_text(difference).encode())
        if html_file:
            from evalkit.diff.page import difference_page

            write_atomic(html_file, difference_page(difference, verdicts, pictures).encode())
    for file in (json_file, csv_file, html_file):
        if file:
            click.echo(f"Written: {file}")
    for verdict in verdicts:
        click.echo(f"{'FAILED' if verdict.fired else 'passed'}: {verdict.words}", err=verdict.fired)
    if any(verdict.fired for verdict in verdicts):
        raise click.exceptions.Exit(1)
