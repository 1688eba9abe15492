"""Option types and options shared by commands."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import click
from posecore.errors import ConfigError

Command = TypeVar("Command", bound=Callable[..., Any])


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


def removed_option(name: str, reason: str) -> Callable[[Command], Command]:
    """A flag that an earlier version had: refused with the reason, in one line."""

    def refuse(ctx: click.Context, param: click.Parameter, value: bool) -> None:
        if value:
            raise ConfigError(f"{name}: removed, {reason}; leave it out")

    return click.option(name, is_flag=True, hidden=True, expose_value=False, callback=refuse)


FOLDER = click.Path(path_type=Path)
NEW_FILE = click.Path(path_type=Path, dir_okay=False)
split_option = click.option("--split", help="Split folder. Default: test, val, train_pbr, train or the only one.")
vss_option = click.option(
    "--vss",
    type=click.Choice(["full", "visible"]),
    default="full",
    show_default=True,
    help="Whole silhouettes, or their visible parts (needs depth images).",
)
workers_option = click.option(
    "--workers",
    type=click.IntRange(1),
    default=1,
    show_default=True,
    help="Processes that score poses; the results do not depend on it.",
)
