"""`synthgen bop`."""

from typing import TYPE_CHECKING, Any

import click
from posecore.command_line import progress_bar

from synthgen.cli.options import echo_lines, required_out, resumable, scene_options

if TYPE_CHECKING:
    from synthgen.bop.frame_maker import Split
    from synthgen.inputs.sources import Sources


@click.command()
@scene_options
@required_out
@click.option(
    "--frames", required=True, type=click.IntRange(1), help="Number of images; with --sequence, per sequence."
)
@click.option(
    "--objects-per-frame",
    nargs=2,
    type=click.IntRange(1),
    metavar="LO HI",
    help="Range of the number of labelled objects in an image. [preset, 1 1]",
)
@click.option(
    "--frames-per-scene",
    type=click.IntRange(1),
    help="Images per layout, each from another camera: a layout is a BOP scene, 000000 on. [every image has its own "
    "layout, all in scene 000001]",
)
@click.option(
    "--split",
    type=click.Choice(["test", "val", "train_pbr"]),
    default="test",
    show_default=True,
    help="BOP split. train_pbr has JPEG images and no targets file, as in BOP. Splits have no common scene.",
)
@click.option("--sequence", is_flag=True, help="Smooth tracking sequences instead of single images.")
@click.option("--sequences", type=click.IntRange(1), help="Number of sequences, scenes 000001 on. [1 with --sequence]")
@click.option("--fps", type=click.FloatRange(0.1), help="Images per second of sequences. [preset, 30]")
@click.option("--workers", type=click.IntRange(1), default=1, show_default=True, help="Processes that render.")
def bop(
    sources: "Sources",
    out: str,
    frames: int,
    objects_per_frame: tuple[int, int] | None,
    frames_per_scene: int | None,
    split: "Split",
    sequence: bool,
    sequences: int | None,
    fps: float | None,
    workers: int,
    preset: str,
    overrides: tuple[str, ...],
    quiet: bool,
    **values: Any,
) -> None:
    """Render whole camera images, or tracking sequences, with ground truth as a BOP dataset.

    The images follow the same preset as training pairs, but show other scenes. A stop at any moment, even kill -9,
    loses only the images in progress; the same command again continues and ends with the same bytes, with any number of
    workers.

    \b
    synthgen bop --object mesh.ply --frames 50 --out test_bop
    synthgen bop --object mesh.ply --frames 20 --out test_bop --preset quickstart --engine raster --seed 7
    synthgen bop --object models/ --frames 200 --objects-per-frame 3 8 --out test_bop --workers 4
    synthgen bop --object models/ --frames 5000 --frames-per-scene 25 --split train_pbr --preset pbr --out pbr
    synthgen bop --object mesh.ply --sequence --frames 300 --sequences 4 --fps 30 --out tracks
    """
    from posecore.errors import ConfigError

    from synthgen.bop.frame_maker import FramePlan
    from synthgen.config import load_config
    from synthgen.run.bop import BopJob, render_bop_dataset

    if not sequence and (sequences is not None or fps is not None):
        raise ConfigError(f"--{'fps' if sequences is None else 'sequences'}: is for sequences alone; add --sequence")
    if objects_per_frame is not None:
        overrides = (*overrides, f"frames.objects=[{objects_per_frame[0]}, {objects_per_frame[1]}]")
    if fps is not None:
        overrides = (*overrides, f"sequence.fps={fps}")
    plan = FramePlan(
        split=split,
        frames=frames,
        frames_per_scene=frames_per_scene,
        sequences=(sequences or 1) if sequence else None,
    )
    config = load_config(preset, overrides, values)
    job = BopJob(out=out, plan=plan, config=config, sources=sources, workers=workers)
    with resumable(out), progress_bar(quiet) as bar:
        task = bar.add_task("frames", total=job.frames, visible=False)
        summary = render_bop_dataset(
            job,
            on_objects=echo_lines,
            on_frame=lambda scene_id, im_id: bar.update(task, advance=1, visible=True),
        )
    click.echo(summary.text, err=True)
