"""Parts that the programs' command lines share."""

import importlib
import logging
import subprocess
import sys

import click
import pytest
from children import started
from click.testing import CliRunner
from posecore.command_line import (
    CONTEXT_SETTINGS,
    ErrorReportingGroup,
    end_early,
    progress_bar,
    renamed_arguments,
    renamed_options,
    start_logging,
    stoppable,
    verbose_option,
)
from posecore.errors import ConfigError, ShardError


@click.group(cls=ErrorReportingGroup, context_settings=CONTEXT_SETTINGS)
def main():
    """Program of one test."""


def run(*arguments):
    return CliRunner().invoke(main, arguments)


def raising(error):
    group = ErrorReportingGroup("main")

    @group.command()
    def work():
        raise error

    return CliRunner().invoke(group, ["work"])


@pytest.mark.parametrize("program", ["synthgen", "refinenet", "evalkit"])
def test_every_program_reports_errors_this_way(program):
    group = importlib.import_module(f"{program}.cli").main
    assert type(group) is ErrorReportingGroup
    assert group.context_settings == CONTEXT_SETTINGS


def test_a_reader_that_has_seen_enough_is_no_error():
    """`evalkit tables | head` closes the pipe."""
    result = raising(BrokenPipeError(32, "Broken pipe"))
    assert (result.exit_code, result.stderr) == (1, "")


@pytest.mark.parametrize(
    ("error", "line", "code"),
    [
        (ConfigError("n is 0"), "Error: n is 0\n", 2),
        (ShardError("broken"), "Error: broken\n", 1),
        (PermissionError(13, "Permission denied", "a/b"), "Error: a/b: no permission to write here", 1),
    ],
)
def test_errors_are_one_line_and_an_exit_code(error, line, code):
    result = raising(error)
    assert result.stderr.startswith(line)
    assert result.stderr.count("\n") == 1
    assert (result.exit_code, result.stdout) == (code, "")


@main.command()
@renamed_options({"--sure": "--tracking-threshold", "--quick": "--fast"})
@click.option("--tracking-threshold", type=float, required=True)
@click.option("--fast", is_flag=True)
def track(tracking_threshold, fast):
    click.echo(f"{tracking_threshold} {fast}")


@pytest.mark.parametrize("arguments", [["--sure", "0.5"], ["--sure=0.5"], ["--sure"]])
def test_a_renamed_option_is_refused_with_its_new_name(arguments):
    result = run("track", *arguments)
    assert result.exit_code == 2
    assert "Error: --sure is now --tracking-threshold\n" in result.stderr


def test_a_renamed_flag_too_and_neither_is_in_the_help():
    assert "--quick is now --fast" in run("track", "--tracking-threshold", "1", "--quick").stderr
    help_text = run("track", "-h").stdout
    assert "--fast" in help_text
    assert "--sure" not in help_text
    assert "--quick" not in help_text
    assert run("track", "--tracking-threshold", "1", "--fast").stdout == "1.0 True\n"


@main.command()
@verbose_option("a_program")
def log():
    logging.getLogger("a_program.part").info("a detail")
    logging.getLogger("a_library").info("a detail of another")


def test_verbose_shows_details_of_the_program_alone(caplog, monkeypatch):
    monkeypatch.setattr(logging.getLogger("a_program"), "level", 0)
    assert run("log").exit_code == 0
    assert caplog.messages == []
    assert run("log", "--verbose").exit_code == 0
    assert caplog.messages == ["a detail"]


def test_evalkit_refuses_verbose_before_the_command():
    result = CliRunner().invoke(importlib.import_module("evalkit.cli").main, ["-v", "report"])
    assert result.exit_code == 2
    assert "-v is now --verbose after the command" in result.stderr


@main.command()
@click.option("--kept")
def stop(kept):
    with stoppable(lambda: kept):
        raise KeyboardInterrupt


def test_an_interruption_ends_with_one_line():
    result = run("stop", "--kept", "it is in out")
    assert (result.exit_code, result.stderr) == (130, "Stopped: it is in out\n")
    assert run("stop").stderr == "Stopped: nothing was finished, nothing is written\n"


def test_an_error_that_ends_early_stays_itself(capsys):
    with pytest.raises(ShardError, match="broken"):
        end_early(ShardError("broken"), "half of it is in out")
    assert capsys.readouterr().err == "Stopped: half of it is in out\n"
    with pytest.raises(ShardError):
        end_early(ShardError("broken"), None)
    assert capsys.readouterr().err == ""


def test_the_bar_has_more_columns_at_its_end():
    bar = progress_bar(True, "{task.fields[state]}")
    bar.add_task("pairs", total=3, state="loss 0.1")
    cells = [column.render(bar.tasks[0]) for column in bar.columns if hasattr(column, "text_format")]
    assert [cell.plain for cell in cells] == ["pairs", "left", "loss 0.1"]


def test_nothing_is_printed_before_the_first_visible_task(capsys):
    with progress_bar(False) as bar:
        bar.add_task("pairs", total=None, visible=False)
    assert capsys.readouterr().err == ""
    with progress_bar(False) as bar:
        bar.update(bar.add_task("pairs", total=None, visible=False), total=3, completed=3, visible=True)
    assert "3/3" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (("lmo",), "lmo is now --dataset lmo"),
        (("lmo", "a.csv", "b.csv"), "is now --dataset lmo --results a.csv --results b.csv"),
    ],
)
def test_positional_arguments_of_earlier_versions_are_refused_with_their_options(arguments, text):
    @click.command()
    @click.option("--dataset", required=True)
    @renamed_arguments("--dataset", "--results")
    def check(dataset):
        click.echo(dataset)

    refused = CliRunner().invoke(check, arguments)
    assert refused.exit_code == 2
    assert text in refused.stderr
    assert CliRunner().invoke(check, ["--dataset", "lmo"]).output == "lmo\n"
    assert "Usage: check [OPTIONS]" in CliRunner().invoke(check, ["--help"]).output


WORK = """
import time
import click
from posecore.command_line import ErrorReportingGroup, stoppable

@click.group(cls=ErrorReportingGroup)
def main():
    pass

@main.command()
def work():
    with stoppable(lambda: "half is in out"):
        print("begun", flush=True)
        time.sleep(7200)

main()
"""


def test_a_termination_signal_ends_a_command_as_ctrl_c_does():
    words = [sys.executable, "-c", WORK, "work"]
    with started(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdout.readline() == "begun\n"
        process.terminate()
        _, errors = process.communicate()
    assert (process.returncode, errors) == (130, "Stopped: half is in out\n")


@main.command()
@click.argument("path", type=click.Path(path_type=str), required=False)
@click.option("--count", type=click.IntRange(0))
@click.option("--ratio", type=click.FloatRange(0))
@click.option("--set", "assignments", multiple=True)
@click.option("--fail")
def values(path, count, ratio, assignments, fail):
    if fail:
        raise ConfigError(f"{fail}: is wrong")
    click.echo(f"{path} {count} {ratio} {assignments}")


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        ([""], "an argument: the value is empty, expected one; leave it out for the default"),
        (["--count", ""], "--count: the value is empty"),
        (["--count="], "--count: the value is empty"),
        (["--count", "9" * 400], "Invalid value for '--count': the number has more than 64 bits"),
        (["--count", "9" * 5000], "Invalid value for '--count'"),
        (["--ratio", "1e400"], "Invalid value for '--ratio': found inf, expected a finite number"),
        (["--ratio", "nan"], "Invalid value for '--ratio': found nan, expected a finite number"),
        (["--ratio", "9" * 400], "Invalid value for '--ratio': found inf, expected a finite number"),
        (["--fail", "\x1b[31m"], "Error: \\x1b[31m: is wrong"),
        (["--fail", "a\nError: b"], "Error: a\\x0aError: b: is wrong"),
        (["--fail", "x" * 100_000], "x..."),
        (["--fail", "\udcff\u202e"], "Error: \\xff\\u202e: is wrong"),
        (["--\x1b[2J"], "No such option '--\\x1b[2J'"),
    ],
    ids=lambda value: str(value)[:30].encode("unicode_escape").decode(),
)
def test_values_that_no_command_takes_are_one_printable_line(arguments, line):
    result = run("values", *arguments)
    assert result.exit_code == 2
    (error,) = [text for text in result.stderr.splitlines() if text.startswith("Error: ")]
    assert line in error
    assert error.isprintable()
    assert len(error) < 2100


def test_an_unknown_command_is_printable():
    result = run("\x1b[31mred")
    assert result.exit_code == 2
    assert "\x1b" not in result.stderr
    assert "\\x1b[31mred" in result.stderr


def test_values_that_commands_take_pass():
    taken = run("values", "--set", "key=", "--set=a=b", "--count", str(2**63 - 1))
    assert taken.stdout.startswith("None 9223372036854775807")


def test_log_lines_are_printable(monkeypatch, capsys):
    monkeypatch.setattr(logging.getLogger(), "handlers", [])
    start_logging("a_program", verbose=False)
    logging.getLogger("a_program").warning("%s", "\x1b[2J\nWARNING forged")
    assert capsys.readouterr().err == "WARNING a_program: \\x1b[2J\\x0aWARNING forged\n"
