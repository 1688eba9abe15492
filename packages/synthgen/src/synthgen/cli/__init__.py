"""The `synthgen` command: render training pairs, render BOP frames, look at what was rendered."""

import click

from synthgen.cli.bop import bop
from synthgen.cli.group import CleanGroup
from synthgen.cli.preview import preview
from synthgen.cli.render import render

_CONTEXT = {"help_option_names": ["-h", "--help"], "show_default": True, "max_content_width": 110}


@click.group(cls=CleanGroup, context_settings=_CONTEXT)
@click.version_option(package_name="synthgen")
def main() -> None:
    """Render training pairs and test images of an object from its mesh.

    \b
    synthgen render --object mesh.ply --n 20000 --out shards
    synthgen preview shards --out sheet.png
    synthgen bop --object mesh.ply --frames 50 --out test_bop
    """


for _command in (render, bop, preview):
    main.add_command(_command)
