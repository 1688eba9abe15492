"""`refinenet track`."""

from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

import click
from posecore.command_line import end_early, progress_bar, renamed_options

from refinenet.cli.options import (
    FILE,
    NEW_FILE,
    checkpoint_option,
    device_option,
    iterations_option,
    method_option,
    other_mesh_option,
    quiet_option,
    refuse_unused_network_options,
    require_distinct_files,
    require_used,
    threads_option,
    verbose_option,
)
from refinenet.refine.registry import MethodName, MethodSettings

if TYPE_CHECKING:
    from posecore.mesh import Units

    from refinenet.tracking.run import TrackJob, TrackSummary

SHOWN_REASONS = 3


@click.command()
@click.argument("source", type=FILE, required=False)
@click.option("--dataset", type=FILE, metavar="DIR", help="BOP dataset with the images, instead of SOURCE.")
@method_option
@checkpoint_option
@click.option("--out", required=True, type=NEW_FILE, metavar="CSV", help="Poses, a BOP result file.")
@click.option("--init", type=FILE, metavar="CSV", help="Initial poses, a BOP result file; also restart a lost object.")
@click.option(
    "--pose", type=FILE, metavar="JSON", help="Initial poses as a list of scene_gt.json: obj_id, cam_R_m2c, ..."
)
@click.option("--split", metavar="NAME", help="Split of a BOP dataset. [test, val, train_pbr, train or the only one]")
@click.option(
    "--scene", type=click.IntRange(0), help="Scene of a BOP dataset; of images in the result file. [only one, 0]"
)
@click.option("--camera", type=FILE, metavar="JSON", help="Camera of images or a video: a BOP camera.json.")
@click.option(
    "--mesh", "mesh_files", type=FILE, multiple=True, metavar="FILE",
    help="Mesh for images or a video; obj_000005.ply is object 5, any other name the only object. Repeatable.",
)  # fmt: skip
@click.option("--units", type=click.Choice(["mm", "cm", "m"]), default="mm", help="Unit of --mesh.")
@click.option("--object", "objects", type=int, multiple=True, help="Track only this object. Repeatable. [all]")
@iterations_option
@click.option(
    "--motion-model", is_flag=True, help="Predict poses at constant velocity, instead of as in the last frame."
)
@click.option(
    "--tracking-threshold", type=click.FloatRange(0, 1),
    help="Least confidence of a pose for the state tracking. [0.35, learned 0.5, search 0.4]",
)  # fmt: skip
@click.option(
    "--accept-threshold", type=click.FloatRange(0, 1),
    help="Least confidence of a pose that is accepted at all. [0.2, search 0.4]",
)  # fmt: skip
@click.option("--patience", type=click.IntRange(1), default=5, help="Frames without a pose until an object is lost.")
@click.option(
    "--depth-step", type=click.FloatRange(0, 0.5, max_open=True),
    help="Also try each pose nearer and farther by this fraction of its depth; 0 is faster, and depth may drift. "
    "[0.02; 0 for preset flow and for a method without confidences]",
)  # fmt: skip
@click.option("--video", type=NEW_FILE, metavar="FILE", help="Write a video (.mp4, .avi) with contours and states.")
@click.option("--fps", type=click.FloatRange(0.1), default=30.0, help="Frames per second of --video.")
@click.option("--name", help="Method's name in the report. [the preset and the checkpoint's step]")
@device_option
@threads_option
@other_mesh_option
@quiet_option
@verbose_option
@renamed_options({"--sure": "--tracking-threshold", "--found": "--accept-threshold"})
def track(
    source: Path | None,
    dataset: Path | None,
    method: MethodName,
    checkpoint: Path | None,
    out: Path,
    init: Path | None,
    pose: Path | None,
    split: str | None,
    scene: int | None,
    camera: Path | None,
    mesh_files: tuple[Path, ...],
    units: "Units",
    objects: tuple[int, ...],
    iterations: int,
    motion_model: bool,
    tracking_threshold: float | None,
    accept_threshold: float | None,
    patience: int,
    depth_step: float | None,
    video: Path | None,
    fps: float,
    name: str | None,
    device: str,
    threads: int,
    allow_other_mesh: bool,
    quiet: bool,
) -> None:
    """Track objects through SOURCE, a folder of images or a video file, or through a scene of a BOP dataset.

    The poses of each frame start the refinement of the next. An object is tracking, uncertain, or lost; a lost object
    has no pose in the result file until an initial pose of --init or --pose fits, or it is found at its last pose.

    \b
    refinenet track --dataset choi --scene 1 --checkpoint best.safetensors --init start.csv --out results/track.csv
    refinenet track --dataset choi --scene 1 --method edge-icp --init start.csv --out results/edges.csv
    refinenet track clip.mp4 --camera camera.json --mesh part.ply --pose start.json --checkpoint best.safetensors \\
        --out track.csv --video annotated.mp4
    """
    settings = MethodSettings(
        method=method, checkpoint=checkpoint, iterations=iterations, device=device, allow_other_mesh=allow_other_mesh
    )
    refuse_unused_network_options(settings)
    if video is None:
        require_used("without --video", "fps")
    require_distinct_files(
        {
            "SOURCE": source,
            "--dataset": dataset,
            "--init": init,
            "--pose": pose,
            "--camera": camera,
            "--checkpoint": checkpoint,
        },
        {"--out": out, "--video": video},
    )
    from refinenet.tracking.run import TrackJob, track_to_file

    job = TrackJob(
        method=settings, dataset=dataset, source=source, out=out, init=init, pose=pose, split=split, scene=scene,
        camera=camera, mesh_files=mesh_files, units=units, objects=objects, motion_model=motion_model,
        tracking_threshold=tracking_threshold, accept_threshold=accept_threshold, patience=patience,
        depth_step=depth_step, video=video, fps=fps, name=name, threads=threads,
    )  # fmt: skip
    with progress_bar(quiet) as bar:
        task = bar.add_task("frames", total=None, visible=False)
        try:
            summary = track_to_file(
                job, lambda done, total: bar.update(task, completed=done, total=total, visible=True)
            )
        except KeyboardInterrupt as error:
            end_early(error, None)
    _print(job, summary)
    if summary.stopped is not None:
        end_early(summary.stopped, f"what was tracked is in {out}")


def _print(job: "TrackJob", summary: "TrackSummary") -> None:
    """Print counts and speed, and the commonest failures to stderr."""
    log = summary.log
    counts = ", ".join(f"{count} {state}" for state, count in log.states.items())
    click.echo(f"{job.out}: {log.frames} frames, {counts}; {len(log.resets)} starts from an initial pose")
    if log.frames:
        click.echo(
            f"{log.frames / log.tracking_s:.1f} frames/s tracking, "
            f"{log.frames / log.total_s:.1f} with reading{' and drawing' if job.video else ''}"
        )
    for reason, count in Counter(miss["why"] for miss in log.misses).most_common(SHOWN_REASONS):
        click.echo(f"No pose, {count} times: {reason}", err=True)
