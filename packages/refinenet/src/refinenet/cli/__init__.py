"""The `refinenet` command: one module for each of its commands."""

import click
from posecore.command_line import CONTEXT_SETTINGS, ErrorReportingGroup

from refinenet.cli.export import export
from refinenet.cli.refine import refine
from refinenet.cli.track import track
from refinenet.cli.train import train


@click.group(cls=ErrorReportingGroup, context_settings=CONTEXT_SETTINGS)
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
