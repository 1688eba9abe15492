"""The `evalkit` command."""

import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click
from posecore.bop import BopDataset
from posecore.errors import PoseError, exit_code
from posecore.files import storage_error
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from evalkit import __version__
from evalkit.evaluate import VssKind
from evalkit.files import dataset_of, find_result_files
from evalkit.pairing import Level
from evalkit.perturb import levels_of, perturb_dataset
from evalkit.report import write_report


class CleanGroup(click.Group):
    """A group whose commands end with one line on stderr for every error a user can cause."""

    def invoke(self, ctx: click.Context) -> Any:
        """Run a command; turn PoseError into `Error: ...` and its exit code."""
        try:
            return super().invoke(ctx)
        except PoseError as error:
            click.echo(f"Error: {error}", err=True)
            ctx.exit(exit_code(error))
        except OSError as error:
            click.echo(f"Error: {storage_error(error.filename or 'storage', error)}", err=True)
            ctx.exit(1)


class Numbers(click.ParamType):
    """Comma-separated numbers."""

    name = "N,N,..."

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[float, ...]:
        """Parse `5,10,15`."""
        if isinstance(value, tuple):
            return value
        try:
            return tuple(float(part) for part in str(value).split(",") if part.strip())
        except ValueError:
            self.fail(f"'{value}' is not a list of numbers such as 5,10,15", param, ctx)


FOLDER = click.Path(path_type=Path)
NEW_FILE = click.Path(path_type=Path, dir_okay=False)
split_option = click.option("--split", help="Split folder. Default: test, val, train_pbr, train or the only one.")


@click.group(cls=CleanGroup, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="evalkit")
@click.option("-v", "--verbose", is_flag=True, help="Log what is read and rendered.")
def main(verbose: bool) -> None:
    """Measure 6D poses against BOP ground truth.

    \b
    Examples:
      evalkit perturb --dataset lmo --out results/start.csv --random-up-to 20
      evalkit report
    """
    logging.basicConfig(level=logging.INFO if verbose else logging.WARNING, format="%(name)s: %(message)s")


@main.command()
@click.option("--dataset", type=FOLDER, help="BOP dataset folder. Default: the one the results' sidecars name.")
@click.option(
    "--results", multiple=True, type=FOLDER, help="BOP result file; repeat it to compare. Default: all with a sidecar."
)
@click.option("--out", type=FOLDER, default=Path("report"), show_default=True, help="Folder for the report.")
@split_option
@click.option(
    "--vss",
    type=click.Choice(["full", "visible"]),
    default="full",
    show_default=True,
    help="Whole silhouettes, or their visible parts (needs depth images).",
)
@click.option("--worst", type=click.IntRange(0, 200), default=12, show_default=True, help="Pictures of worst cases.")
def report(
    dataset: Path | None, results: tuple[Path, ...], out: Path, split: str | None, vss: VssKind, worst: int
) -> None:
    """Write a report: one HTML page, a CSV line for each pose, a JSON summary.

    Without options, it takes the result files (*.csv with *.csv.json beside it) in this folder and in results/, and
    the dataset that their sidecars name.

    \b
    Examples:
      evalkit report
      evalkit report --dataset lmo --results start.csv --results refined.csv --out report
    """
    here = Path()
    paths = list(results) or find_result_files(here)
    opened = BopDataset(dataset or dataset_of(paths, here), split)
    with _progress() as progress:

        def start(name: str, total: int) -> Callable[[int], None]:
            task = progress.add_task(name, total=total)
            return lambda done: progress.advance(task, done)

        written = write_report(opened, paths, out, vss=vss, worst=worst, start=start)
    for item in written.summary["against_start"]:
        click.echo(item["words"])
    for file in written.summary["files"]:
        click.echo(_total_line(file))
    click.echo(f"Report: {written.page}")


def _progress() -> Progress:
    console = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    return Progress(*columns, console=console, transient=True, disable=not console.is_terminal)


def _total_line(file: dict[str, Any]) -> str:
    total = file["total"]
    missing = f", {total['missing']} missing" if total["missing"] else ""
    return (
        f"{file['name']}: {total['expected']} poses{missing}, VSS {total['vss_mean']:.3f}, "
        f"ADD(-S) at 0.1 diameter {100 * total['add_s_recall_0.1d']:.1f} %"
    )


@main.command()
@click.option("--dataset", type=FOLDER, required=True, help="BOP dataset folder with ground truth.")
@click.option("--out", type=NEW_FILE, required=True, help="Result file to write; its sidecar goes beside it.")
@split_option
@click.option("--angles", type=Numbers(), default=(), help="Rotations, degrees: one start for each.")
@click.option("--translations", type=Numbers(), default=(), help="Translations, object diameters: one start for each.")
@click.option("--random-up-to", type=click.FloatRange(0, 180), help="One more start, rotated by 0 to this, degrees.")
@click.option(
    "--random-translation",
    type=click.FloatRange(0),
    help="The random start is moved by 0 to this, object diameters. Default: 0.",
)
@click.option("--seed", type=click.IntRange(0), default=0, show_default=True, help="Seed of all draws.")
def perturb(
    dataset: Path,
    out: Path,
    split: str | None,
    angles: tuple[float, ...],
    translations: tuple[float, ...],
    random_up_to: float | None,
    random_translation: float | None,
    seed: int,
) -> None:
    """Write start poses: ground truth rotated and moved by known amounts.

    The sidecar records the level of every line, from which `evalkit report` draws convergence curves.

    \b
    Examples:
      evalkit perturb --dataset lmo --out start.csv --random-up-to 20 --random-translation 0.2
      evalkit perturb --dataset lmo --out curve.csv --angles 5,10,15,30,45 --translations 0.1,0.5,1
    """
    limit = None
    if random_up_to is not None or random_translation is not None:
        limit = Level(angle_deg=random_up_to or 0.0, translation_diameter=random_translation or 0.0)
    count = perturb_dataset(
        BopDataset(dataset, split), out, levels=levels_of(angles, translations), seed=seed, random_up_to=limit
    )
    click.echo(f"{count} start poses: {out}")
