"""`synthgen merge`."""

import click
from posecore.command_line import progress_bar

from synthgen.cli.options import QUIET, required_out, resumable


@click.command()
@click.argument("shards", nargs=-1, required=True, metavar="SHARDS SHARDS...")
@required_out
@QUIET
def merge(shards: tuple[str, ...], out: str, quiet: bool) -> None:
    """Merge several complete datasets of SHARDS (folders or URLs) into a single one for training.

    All must have equal patches and numbers of contour points, and equal meshes of common objects. Scenes are
    renumbered: scenes of different datasets keep different numbers, since validation holds out whole scenes.

    \b
    synthgen merge rendered real --out both
    synthgen merge seed1 seed2 seed3 --out s3://bucket/all
    """
    if len(shards) < 2:
        raise click.UsageError("give two datasets or more")
    from synthgen.pairs.merge import merge_datasets

    with resumable(out), progress_bar(quiet) as bar:
        task = bar.add_task("pairs", visible=False)
        pairs = merge_datasets(
            shards,
            out,
            on_start=lambda total: bar.reset(task, total=total, visible=True),
            on_shard=lambda count: bar.advance(task, count),
        )
    click.echo(f"{out}: complete, {pairs} pairs of {len(shards)} datasets", err=True)
