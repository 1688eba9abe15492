"""`synthgen merge`."""

import click
from posecore.command_line import progress_bar

from synthgen.cli.options import resumable


@click.command()
@click.argument("datasets", nargs=-1, required=True, metavar="DATASET DATASET...")
@click.option("--out", required=True, type=str, metavar="DIR", help="Where to. The same command again continues it.")
@click.option("--quiet", is_flag=True, help="No progress bar.")
def merge(datasets: tuple[str, ...], out: str, quiet: bool) -> None:
    """Write complete shard DATASETs (folders or URLs) as one, to train on all of them.

    Patches, contour points and the meshes of objects that several of them have must be the same. Scenes are numbered
    on: none of one dataset is taken for one of another when scenes are held out.

    \b
    synthgen merge rendered real --out both
    synthgen merge seed1 seed2 seed3 --out s3://bucket/all
    """
    if len(datasets) < 2:
        raise click.UsageError("give two datasets or more")
    from posecore.shard import ShardWriter

    from synthgen.pairs.merge import merged_card, open_parts, write_merged
    from synthgen.run import lock

    parts = open_parts(datasets)
    card = merged_card(parts)
    with lock.held(out), resumable(out), progress_bar(quiet) as bar:
        writer = ShardWriter.create(out, card)
        task = bar.add_task("pairs", total=card["n"])
        write_merged(parts, writer, lambda count: bar.advance(task, count))
    click.echo(f"{out}: complete, {card['n']} pairs of {len(parts)} datasets", err=True)
