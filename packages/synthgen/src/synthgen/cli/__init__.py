"""The `synthgen` command: render training pairs and BOP images, verify and inspect datasets."""

import click
from posecore.command_line import CONTEXT_SETTINGS, ErrorReportingGroup

from synthgen.cli.bop import bop
from synthgen.cli.cut import cut
from synthgen.cli.doctor import doctor
from synthgen.cli.export import export
from synthgen.cli.info import info
from synthgen.cli.merge import merge
from synthgen.cli.preview import preview
from synthgen.cli.render import render
from synthgen.cli.verify import verify


@click.group(cls=ErrorReportingGroup, context_settings=CONTEXT_SETTINGS)
@click.version_option(package_name="synthgen")
def main() -> None:
    """Render training pairs and test images of an object from its mesh.

    \b
    synthgen render --object mesh.ply --n 200000
    synthgen doctor
    synthgen verify shards --report verify.html
    synthgen preview shards --out sheet.png
    synthgen bop --object mesh.ply --frames 50 --out test_bop
    synthgen cut --dataset images --split train_real --out shards
    """


for _command in (bop, cut, doctor, export, info, merge, preview, render, verify):
    main.add_command(_command)
