"""`synthgen export`."""

from pathlib import Path
from typing import TYPE_CHECKING

import click
from posecore.command_line import progress_bar, renamed_arguments

from synthgen.cli.options import QUIET

if TYPE_CHECKING:
    from synthgen.pairs.export import Layout


@click.command()
@click.argument("shards", type=str)
@renamed_arguments("--out")
@click.option(
    "--out",
    required=True,
    type=click.Path(path_type=Path),
    metavar="FILE|DIR",
    help="File of hdf5, folder of webdataset.",
)
@click.option(
    "--format",
    "layout",
    type=click.Choice(["hdf5", "webdataset"]),
    default="hdf5",
    help="One HDF5 file in the manner of BlenderProc's, or a folder of tars.",
)
@click.option("--overwrite", is_flag=True, help="Replace --out where it exists.")
@QUIET
def export(shards: str, out: Path, layout: "Layout", overwrite: bool, quiet: bool) -> None:
    """Write a complete dataset of SHARDS (folder or URL) in another container.

    The output appears when it is complete. Values are exactly those of the shards.

    \b
    synthgen export shards --out out.h5
    synthgen export shards --out tars --format webdataset
    synthgen export s3://bucket/shards --out out.h5 --overwrite
    """
    from synthgen.pairs.export import export_dataset

    with progress_bar(quiet) as bar:
        task = bar.add_task("pairs", visible=False)
        pairs = export_dataset(
            shards,
            out,
            layout,
            overwrite=overwrite,
            on_start=lambda total: bar.reset(task, total=total, visible=True),
            on_shard=lambda count: bar.advance(task, count),
        )
    click.echo(f"{out}: {pairs} pairs", err=True)
