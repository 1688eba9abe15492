"""The `refinenet` command: one module for each of its commands."""

import click

from refinenet.cli.export import export
from refinenet.cli.group import CleanGroup
from refinenet.cli.refine import refine
from refinenet.cli.track import track
from refinenet.cli.train import train

_CONTEXT = {"help_option_names": ["-h", "--help"], "show_default": True, "max_content_width": 110}


@click.group(cls=CleanGroup, context_settings=_CONTEXT)
@click.version_option(package_name="refinenet")
def main() -> None:
    """Train pose refinement networks and refine poses with them.

    \b
    refinenet train shards/
    refinenet refine --checkpoint runs/compact/best.safetensors --dataset lmo --init start.csv --out refined.csv
    refinenet track clip.mp4 --camera camera.json --mesh part.ply --pose start.json --checkpoint best.safetensors \\
        --out track.csv
    """


for _command in (export, refine, track, train):
    main.add_command(_command)
