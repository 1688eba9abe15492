"""`synthgen export`."""

from pathlib import Path

import click
from posecore.command_line import progress_bar


@click.command()
@click.argument("shards", type=str)
@click.argument("out", type=click.Path(path_type=Path))
@click.option(
    "--format",
    "layout",
    type=click.Choice(["hdf5", "webdataset"]),
    default="hdf5",
    help="One HDF5 file in the manner of BlenderProc's, or a folder of tars.",
)
@click.option("--overwrite", is_flag=True, help="Replace OUT where it exists.")
@click.option("--quiet", is_flag=True, help="No progress bar.")
def export(shards: str, out: Path, layout: str, overwrite: bool, quiet: bool) -> None:
    """Write a complete dataset of SHARDS (folder or URL) as OUT in another container.

    OUT appears when it is complete. Every value is the one that the shards hold.

    \b
    synthgen export shards out.h5
    synthgen export shards tars --format webdataset
    synthgen export s3://bucket/shards out.h5 --overwrite
    """
    from posecore.shard import ShardReader

    from synthgen.pairs.export import refuse_existing, to_hdf5, to_webdataset

    refuse_existing(out, overwrite)
    n = ShardReader(shards).n
    with progress_bar(quiet) as bar:
        task = bar.add_task("pairs", total=n)
        write = to_hdf5 if layout == "hdf5" else to_webdataset
        write(shards, out, overwrite=overwrite, on_shard=lambda count: bar.advance(task, count))
    click.echo(f"{out}: {n} pairs", err=True)
