"""`evalkit check`."""

import sys
from pathlib import Path

import click

from evalkit.cli.options import FOLDER, NEW_FILE, split_option, verbose_option


@click.command()
@click.argument("dataset", type=FOLDER)
@click.argument("results", nargs=-1, type=FOLDER)
@split_option
@click.option("--sensor", help="Camera of several, such as cam1; rgb,gray1 where scenes differ.")
@click.option("--samples", type=click.IntRange(0), default=100, help="Images to decode, spread evenly.")
@click.option("--all", "show_all", is_flag=True, help="List every violation. Default: the first 10 of each kind.")
@click.option("--json", "json_file", type=NEW_FILE, metavar="FILE", help="Write the findings for programs.")
@verbose_option
@click.pass_context
def check(
    ctx: click.Context,
    dataset: Path,
    results: tuple[Path, ...],
    split: str | None,
    sensor: str | None,
    samples: int,
    show_all: bool,
    json_file: Path | None,
) -> None:
    """List everything that is wrong in a BOP dataset and in result files.

    Reads every annotation, model and result line, decodes some images, and evaluates ground truth against itself.
    Each violation says where it is, what was found and what is right. Exit code 0: no errors; 1: errors; 2: wrong
    usage. Warnings and hints do not change it.

    \b
    Examples:
      evalkit check lmo
      evalkit check lmo results/quick.csv --all --json check.json
      evalkit check xyzibd results.csv --split test --sensor xyz --samples 500
    """
    from posecore.files import write_atomic

    from evalkit.check.run import check as run_checks

    findings = run_checks(
        dataset, results, split=split, sensor=sensor, samples=samples, limit=None if show_all else 10, stage=_say
    )
    for line in findings.lines():
        click.echo(line)
    click.echo(findings.summary())
    if json_file is not None:
        write_atomic(json_file, findings.as_json().encode())
    if not findings.ok:
        ctx.exit(1)


def _say(stage: str) -> None:
    if sys.stderr.isatty():
        click.echo(f"checking {stage} ...", err=True)
