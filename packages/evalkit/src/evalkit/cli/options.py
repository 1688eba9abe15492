"""What several commands have in common."""

from pathlib import Path
from typing import Any

import click
from posecore import command_line


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
verbose_option = command_line.verbose_option("evalkit")
split_option = click.option("--split", help="Split folder. Default: test, val, train_pbr, train or the only one.")
vss_option = click.option(
    "--vss",
    type=click.Choice(["full", "visible"]),
    default="full",
    help="Whole silhouettes, or their visible parts (needs depth images).",
)
workers_option = click.option(
    "--workers",
    type=click.IntRange(1),
    default=1,
    help="Processes that score poses; the numbers do not depend on it.",
)
