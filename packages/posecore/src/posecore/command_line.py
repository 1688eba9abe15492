"""Parts that the command lines of all programs share; the extra `posecore[cli]` installs click and rich.

Errors of the project end a command in one line on stderr with an exit code. Logging and progress go to stderr too.
"""

import io
import logging
import math
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from types import FrameType
from typing import TYPE_CHECKING, Any, NoReturn, TypeVar

import click

from posecore.errors import PoseError, exit_code
from posecore.text import printable

if TYPE_CHECKING:
    from rich.progress import Progress

F = TypeVar("F", bound=Callable[..., Any])
CONTEXT_SETTINGS: Mapping[str, Any] = {
    "help_option_names": ["-h", "--help"],
    "show_default": True,
    "max_content_width": 110,
}
"""For the group of each program."""
INTERRUPTED = 130
"""Exit code after Ctrl-C, as of a shell."""


_LONGEST_LINE = 2000
_LARGEST_INTEGER = 2**63 - 1


def error_line(text: object) -> str:
    """An error in one printable line of limited length."""
    line = printable(f"Error: {text}")
    return line if len(line) <= _LONGEST_LINE else f"{line[:_LONGEST_LINE]}..."


class ErrorReportingGroup(click.Group):
    """Group that reports bad input in one line on stderr with an exit code, without a traceback.

    That is `PoseError`, `OSError`, and option values that no command takes: empty ones, and numbers that are not finite
    or do not fit 64 bits.
    """

    def make_context(self, *arguments: Any, **settings: Any) -> click.Context:
        """Parse the options of the group."""
        with _printable_usage_errors():
            return super().make_context(*arguments, **settings)

    def add_command(self, cmd: click.Command, name: str | None = None) -> None:
        """Add a command; its numbers are checked."""
        for parameter in cmd.params:
            parameter.callback = _checked(parameter.callback)
        super().add_command(cmd, name)

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Find the command; an empty argument is refused, of which a path would make the working folder."""
        name, command, rest = super().resolve_command(ctx, args)
        for before, argument in zip(["", *rest], rest, strict=False):
            option, _, value = argument.partition("=")
            if not argument or (option.startswith("--") and argument != option and not value):
                what = option or (before if before.startswith("-") else "an argument")
                raise click.UsageError(f"{what}: the value is empty, expected one; leave it out for the default", ctx)
        return name, command, rest

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command. A termination signal ends it as Ctrl-C does, with its processes and semaphores."""
        if threading.current_thread() is threading.main_thread():  # as job schedulers and service managers end programs
            signal.signal(signal.SIGTERM, _interrupt)
        if isinstance(sys.stdout, io.TextIOWrapper):  # a name that is not UTF-8 is printed with escapes
            sys.stdout.reconfigure(errors="backslashreplace")
        try:
            with _printable_usage_errors():
                return super().invoke(ctx)
        except PoseError as error:
            click.echo(error_line(error), err=True)
            ctx.exit(exit_code(error))
        except BrokenPipeError:  # `| head` has read enough: click ends quietly
            raise
        except OSError as error:
            from posecore.files import storage_error

            click.echo(error_line(storage_error(error.filename or "storage", error)), err=True)
            ctx.exit(1)


def _interrupt(signal_number: int, frame: FrameType | None) -> None:
    raise KeyboardInterrupt


@contextmanager
def _printable_usage_errors() -> Iterator[None]:
    try:
        yield
    except click.ClickException as error:
        text = printable(error.message, keep="\n\t")
        vars(error)["message"] = text if len(text) <= _LONGEST_LINE else f"{text[:_LONGEST_LINE]}..."
        raise


def _checked(callback: Callable[..., Any] | None) -> Callable[..., Any]:
    """A parameter's callback that refuses numbers no command takes, then calls the original."""

    def check(ctx: click.Context, parameter: click.Parameter, value: Any) -> Any:
        for item in value if isinstance(value, tuple | list) else (value,):
            if isinstance(item, float) and not math.isfinite(item):
                raise click.BadParameter(f"found {item}, expected a finite number", ctx, parameter)
            if isinstance(item, int) and abs(item) > _LARGEST_INTEGER:
                raise click.BadParameter("the number has more than 64 bits, expected a smaller one", ctx, parameter)
        return value if callback is None else callback(ctx, parameter, value)

    return check


class _PrintableFormatter(logging.Formatter):
    def formatMessage(self, record: logging.LogRecord) -> str:
        return printable(super().formatMessage(record))


def start_logging(package: str, verbose: bool) -> None:
    """Log to stderr: warnings; of this package and posecore also details if `verbose`."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(_PrintableFormatter("%(levelname)s %(name)s: %(message)s"))
    logging.basicConfig(handlers=[handler])
    for name in (package, "posecore"):
        logging.getLogger(name).setLevel(logging.INFO if verbose else logging.WARNING)


def verbose_option(package: str) -> Callable[[F], F]:
    """The option `--verbose` of a command, which starts the logging; the command has no parameter for it."""

    def start(ctx: click.Context, _: click.Parameter, verbose: bool) -> None:
        if not ctx.resilient_parsing:
            start_logging(package, verbose)

    return click.option("--verbose", is_flag=True, expose_value=False, callback=start, help="Log details to stderr.")


def renamed_options(renamed: Mapping[str, str]) -> Callable[[F], F]:
    """Refuse options of earlier versions, with or without a value: "--sure is now --tracking-threshold".

    Args:
        renamed: New name, or what else replaces it, by old name.
    """

    def refuse(ctx: click.Context, option: click.Parameter, value: str | None) -> None:
        if value is not None and not ctx.resilient_parsing:
            raise click.UsageError(f"{option.opts[0]} is now {renamed[option.opts[0]]}", ctx)

    def decorate(command: F) -> F:
        for number, old in enumerate(renamed):
            command = click.option(
                old, f"renamed_{number}", is_flag=False, flag_value="", is_eager=True, hidden=True,
                expose_value=False, callback=refuse,
            )(command)  # fmt: skip
        return command

    return decorate


def renamed_arguments(*options: str) -> Callable[[F], F]:
    """Refuse positional arguments of earlier versions: "lmo a.csv is now --dataset lmo --results a.csv".

    Goes below the arguments that the command still has.

    Args:
        options: New option of each old argument; further ones have the last option.
    """

    def refuse(ctx: click.Context, _: click.Parameter, values: tuple[str, ...]) -> None:
        if values and not ctx.resilient_parsing:
            new = [f"{options[min(i, len(options) - 1)]} {value}" for i, value in enumerate(values)]
            raise click.UsageError(f"{' '.join(values)} is now {' '.join(new)}", ctx)

    return click.argument("renamed", nargs=-1, metavar="", is_eager=True, expose_value=False, callback=refuse)


@contextmanager
def stoppable(kept: Callable[[], str | None]) -> Iterator[None]:
    """End Ctrl-C with one line and exit code 130.

    Args:
        kept: What remains on the disk and where, for this line; None if nothing does.
    """
    try:
        yield
    except KeyboardInterrupt as interrupt:
        end_early(interrupt, kept())


def end_early(stopped: BaseException, kept: str | None) -> NoReturn:
    """End an interruption with exit code 130, or with the error; one line before names what was kept, if anything."""
    is_interrupted = isinstance(stopped, KeyboardInterrupt)
    if kept is not None or is_interrupted:
        click.echo(printable(f"Stopped: {kept or 'nothing was finished, nothing is written'}"), err=True)
    if is_interrupted:
        raise SystemExit(INTERRUPTED) from None
    raise stopped


def progress_bar(quiet: bool, *extra: str) -> "Progress":
    """A bar on stderr with count, rate, elapsed and remaining time, as a context.

    It starts with the first visible task: an error before that stays on a line of its own.

    Args:
        quiet: Whether nothing is shown.
        extra: More columns at its end, in rich's format strings, such as `{task.fields[state]}`.
    """
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
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

    return _late_progress()(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        Rate(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        *map(TextColumn, extra),
        console=Console(stderr=True),
        disable=quiet,
        speed_estimate_period=120,
    )


def _late_progress() -> "type[Progress]":
    from rich.progress import Progress, TaskID

    class LateProgress(Progress):
        """Starts with its first visible task; stopping without one would print an empty line."""

        def start(self) -> None:
            if any(task.visible for task in self.tasks):
                super().start()

        def stop(self) -> None:
            if self.live.is_started:
                super().stop()

        def add_task(self, *args: Any, **kwargs: Any) -> TaskID:
            task = super().add_task(*args, **kwargs)
            self.start()
            return task

        def update(self, *args: Any, **kwargs: Any) -> None:
            super().update(*args, **kwargs)
            self.start()

        def reset(self, *args: Any, **kwargs: Any) -> None:
            super().reset(*args, **kwargs)
            self.start()

    return LateProgress
