"""What the three commands have in common."""

import importlib

import pytest
from click.testing import CliRunner


@pytest.mark.parametrize("package", ["synthgen", "refinenet", "evalkit"])
def test_a_reader_that_has_seen_enough_is_no_error(package):
    """`evalkit tables | head` closes the pipe."""
    group = importlib.import_module(f"{package}.cli.group").CleanGroup("main")

    @group.command()
    def talk():
        raise BrokenPipeError(32, "Broken pipe")

    result = CliRunner().invoke(group, ["talk"])
    assert result.exit_code == 1
    assert result.stderr == ""
