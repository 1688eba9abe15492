"""`evalkit check`."""

import sys
from pathlib import Path

import click
from posecore.command_line import renamed_arguments

from evalkit.cli.options import FOLDER, NEW_FILE, split_option, verbose_option


@click.command()
@click.option("--dataset", type=FOLDER, help="BOP dataset folder. Default: the one the results' sidecars name.")
@click.option(
    "--results",
    multiple=True,
    type=FOLDER,
    help="BOP result file; repeat it. Default: none with --dataset, else all with a sidecar.",
)
@renamed_arguments("--dataset", "--results")
@split_option
@click.option("--sensor", help="Camera of several, such as cam1; rgb,gray1 where scenes differ.")
@click.option("--samples", type=click.IntRange(0), default=100, help="Images to decode, spread evenly.")
@click.option("--all", "show_all", is_flag=True, help="List every violation. Default: the first 10 of each kind.")
@click.option("--json", "json_file", type=NEW_FILE, metavar="FILE", help="Write the findings as JSON.")
@verbose_option
@click.pass_context
def check(
    ctx: click.Context,
    dataset: Path | None,
    results: tuple[Path, ...],
    split: str | None,
    sensor: str | None,
    samples: int,
    show_all: bool,
    json_file: Path | None,
) -> None:
    """List all faults of a BOP dataset and of result files.

    Reads every annotation, model and result line, decodes some images, and evaluates ground truth against itself.
    Each violation has its file and entry, the value found and the expected one. Exit code 0: no errors; 1: errors;
    2: wrong usage. Warnings and hints do not change it.

    \b
    Examples:
      evalkit check --dataset lmo
      evalkit check --dataset lmo --results results/quick.csv --all --json check.json
      evalkit check --dataset xyzibd --results results.csv --split test --sensor xyz --samples 500
    """
    from posecore.files import write_atomic

    from evalkit.check.run import check as run_checks
    from evalkit.inputs.result_files import dataset_of, find_result_files

    if dataset is None:
        results = results or tuple(find_result_files(Path()))
        dataset = dataset_of(results, Path())
    findings = run_checks(
        dataset,
        results,
        split=split,
        sensor=sensor,
        samples=samples,
        limit=None if show_all else 10,
        on_stage=_show_stage,
    )
    for line in findings.lines():
        click.echo(line)
    click.echo(findings.summary())
    if json_file is not None:
        write_atomic(json_file, findings.as_json().encode())
    if not findings.ok:
        ctx.exit(1)


def _show_stage(stage: str) -> None:
    if sys.stderr.isatty():
        click.echo(f"checking {stage} ...", err=True)
