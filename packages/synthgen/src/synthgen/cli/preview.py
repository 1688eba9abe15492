"""`synthgen preview`."""

from pathlib import Path

import click
from posecore.errors import ConfigError


@click.command()
@click.argument("dataset", type=str)
@click.option("--out", required=True, type=click.Path(path_type=Path), metavar="FILE", help="Picture to write, .png.")
@click.option("--count", type=click.IntRange(1, 200), default=8, help="Samples to show, one a row.")
@click.option("--first", type=click.IntRange(0), default=0, help="Index of the first sample.")
def preview(dataset: str, out: Path, count: int, first: int) -> None:
    """Draw a contact sheet of a shard DATASET: patches with contours, distance transforms, masks and depth.

    \b
    synthgen preview shards --out sheet.png
    synthgen preview shards --out sheet.png --count 20 --first 1000
    """
    import cv2
    from posecore.files import write_atomic

    from synthgen.inspect.preview import contact_sheet

    if out.suffix.lower() not in (".png", ".jpg", ".jpeg"):
        raise ConfigError(f"--out {out}: expected a .png or .jpg file")
    sheet = contact_sheet(dataset, count, first=first)
    ok, data = cv2.imencode(out.suffix, sheet[..., ::-1])
    assert ok
    write_atomic(out, data.tobytes())
    click.echo(f"{out}: {sheet.shape[1]} x {sheet.shape[0]} px", err=True)
