"""`synthgen preview`."""

from pathlib import Path

import click

from synthgen.cli.options import echo_lines


@click.command()
@click.argument("shards", type=str)
@click.option("--out", required=True, type=click.Path(path_type=Path), metavar="FILE", help="Picture to write, .png.")
@click.option("--count", type=click.IntRange(1, 200), default=8, help="Samples to show, one per row.")
@click.option(
    "--first",
    type=click.IntRange(0),
    metavar="I",
    help="Show consecutive samples from this index on. [samples of different scenes, spread over the dataset]",
)
def preview(shards: str, out: Path, count: int, first: int | None) -> None:
    """Draw a contact sheet of SHARDS: patches with contours, distance transforms, masks and depth.

    \b
    synthgen preview shards --out sheet.png
    synthgen preview shards --out sheet.png --count 20 --first 1000
    """
    from synthgen.inspect.preview import save_contact_sheet

    width_px, height_px = save_contact_sheet(shards, out, count, first=first, on_objects=echo_lines)
    click.echo(f"{out}: {width_px} x {height_px} px", err=True)
