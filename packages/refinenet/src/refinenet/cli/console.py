"""What the commands show while they work."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

import click

if TYPE_CHECKING:
    from rich.progress import Progress


def start_logging(verbose: bool) -> None:
    """Log to stderr: warnings, or details too."""
    logging.basicConfig(
        level=logging.INFO if verbose else logging.WARNING, format="%(levelname)s %(name)s: %(message)s"
    )


@contextmanager
def stoppable(where: Path) -> Iterator[None]:
    """Ctrl-C ends with one line; what there is then is in this folder, if anything."""
    try:
        yield
    except KeyboardInterrupt:
        what = f"what was finished is in {where}" if where.exists() else "nothing was finished, nothing is written"
        click.echo(f"Stopped; {what}", err=True)
        raise SystemExit(130) from None


def end_early(stopped: BaseException, kept: str | None) -> NoReturn:
    """End an interruption with exit code 130, or with the error; one line before it says what was kept, if anything."""
    is_interrupted = isinstance(stopped, KeyboardInterrupt)
    if kept is not None or is_interrupted:
        click.echo(f"Stopped: {kept or 'nothing was finished, nothing is written'}", err=True)
    if is_interrupted:
        raise SystemExit(130)
    raise stopped


def progress_bar(quiet: bool, *extra: str) -> "Progress":
    """A bar on stderr, with more columns after its own."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    return Progress(*columns, *map(TextColumn, extra), console=Console(stderr=True), disable=quiet)
