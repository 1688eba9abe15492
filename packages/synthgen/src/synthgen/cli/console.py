"""What the commands show while they work."""

import logging
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import click

if TYPE_CHECKING:
    from rich.progress import Progress


def start_logging(verbose: bool) -> None:
    """Log to stderr: warnings, or details too."""
    logging.basicConfig(format="%(levelname)s %(name)s: %(message)s", stream=sys.stderr)
    logging.getLogger("synthgen").setLevel(logging.INFO if verbose else logging.WARNING)


@contextmanager
def stoppable(out: str) -> Iterator[None]:
    """Ctrl-C ends with one line; what is rendered stays."""
    try:
        yield
    except KeyboardInterrupt:
        click.echo(f"\nStopped. What is rendered stays in {out}; the same command again continues.", err=True)
        sys.exit(130)


def progress_bar(quiet: bool) -> "Progress":
    """A bar with rate and time left on stderr."""
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        ProgressColumn,
        Task,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )
    from rich.text import Text

    class Rate(ProgressColumn):
        """Items a second."""

        def render(self, task: Task) -> Text:
            return Text(f"{task.speed:.2f}/s" if task.speed else "-/s")

    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        Rate(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        console=Console(stderr=True),
        disable=quiet,
        speed_estimate_period=120,
    )
