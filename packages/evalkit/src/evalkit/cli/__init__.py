"""The `evalkit` command: one module for each of its commands."""

import click
from posecore.command_line import CONTEXT_SETTINGS, ErrorReportingGroup, renamed_options

from evalkit import __version__
from evalkit.cli.check import check
from evalkit.cli.diff import diff
from evalkit.cli.perturb import perturb
from evalkit.cli.report import report
from evalkit.cli.tables import tables
from evalkit.cli.tracking import tracking


@click.group(cls=ErrorReportingGroup, context_settings=CONTEXT_SETTINGS)
@click.version_option(__version__, prog_name="evalkit")
@renamed_options({"-v": "--verbose after the command", "--verbose": "an option after the command"})
def main() -> None:
    """Measure 6D poses against BOP ground truth.

    \b
    Examples:
      evalkit perturb --dataset lmo --out results/start.csv --random-up-to 20
      evalkit report
    """


main.add_command(check)
main.add_command(diff)
main.add_command(perturb)
main.add_command(report)
main.add_command(tables)
main.add_command(tracking)
