"""`synthgen bop`."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from synthgen.cli.console import progress_bar, start_logging, stoppable
from synthgen.cli.options import load_meshes, load_photos, scene_options, text

if TYPE_CHECKING:
    from posecore.mesh import Units


@click.command()
@scene_options
@click.option("--frames", required=True, type=click.IntRange(1), help="Number of images.")
def bop(
    objects: tuple[Path, ...],
    out: str,
    frames: int,
    units: "Units",
    preset: str,
    overrides: tuple[str, ...],
    backgrounds: Path | None,
    models_info: Path | None,
    quiet: bool,
    verbose: bool,
    **values: Any,
) -> None:
    """Render whole camera images with ground truth as a BOP dataset (split `test`, scene 1).

    The images follow the same preset as training pairs, but are other scenes.

    \b
    synthgen bop --object mesh.ply --frames 50 --out test_bop
    synthgen bop --object mesh.ply --frames 20 --out test_bop --preset quickstart --engine raster --seed 7
    """
    from synthgen import bopset, dataset
    from synthgen.config import load_config

    start_logging(verbose)
    config = load_config(preset, overrides, values)
    meshes, photos = load_meshes(objects, units), load_photos(backgrounds)
    infos = dataset.load_symmetries(text(models_info), meshes)
    with stoppable(out), progress_bar(quiet) as bar:
        task = bar.add_task("frames", total=frames)
        bopset.write_dataset(
            out, config, meshes, frames, photos=photos, infos=infos, on_frame=lambda _: bar.advance(task)
        )
    click.echo(f"{out}: complete, {frames} frames", err=True)
