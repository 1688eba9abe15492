"""The `evalkit` command: one module for each of its commands."""

import logging

import click

from evalkit import __version__
from evalkit.cli.check import check
from evalkit.cli.diff import diff
from evalkit.cli.group import CleanGroup
from evalkit.cli.perturb import perturb
from evalkit.cli.report import report
from evalkit.cli.tables import tables
from evalkit.cli.tracking import tracking


@click.group(cls=CleanGroup, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="evalkit")
@click.option("-v", "--verbose", is_flag=True, help="Log details to stderr.")
def main(verbose: bool) -> None:
    """Measure 6D poses against BOP ground truth.

    \b
    Examples:
      evalkit perturb --dataset lmo --out results/initial.csv --random-up-to 20
      evalkit report
    """
    logging.basicConfig(level=logging.INFO if verbose else logging.WARNING, format="%(name)s: %(message)s")


main.add_command(check)
main.add_command(diff)
main.add_command(perturb)
main.add_command(report)
main.add_command(tables)
main.add_command(tracking)
