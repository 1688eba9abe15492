"""`synthgen preview`."""

from pathlib import Path

import click


@click.command()
@click.argument("dataset", type=str)
@click.option("--out", required=True, type=click.Path(path_type=Path), metavar="FILE", help="Picture to write, .png.")
@click.option("--count", type=click.IntRange(1, 200), default=8, help="Samples to show, one per row.")
@click.option("--first", type=click.IntRange(0), default=0, help="Index of the first sample.")
def preview(dataset: str, out: Path, count: int, first: int) -> None:
    """Draw a contact sheet of a shard DATASET: patches with contours, distance transforms, masks and depth.

    \b
    synthgen preview shards --out sheet.png
    synthgen preview shards --out sheet.png --count 20 --first 1000
    """
    from synthgen.inspect.preview import save_contact_sheet

    width_px, height_px = save_contact_sheet(dataset, out, count, first=first)
    click.echo(f"{out}: {width_px} x {height_px} px", err=True)
