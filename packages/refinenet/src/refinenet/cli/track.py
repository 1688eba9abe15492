"""`refinenet track`."""

import re
from collections import Counter
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from posecore.command_line import end_early, progress_bar
from posecore.errors import ConfigError, PoseError

from refinenet.cli.options import (
    FILE,
    NEW_FILE,
    checkpoint_option,
    device_option,
    iterations_option,
    method_option,
    other_mesh_option,
    quiet_option,
    require_apart,
    require_fit,
    require_used,
    threads_option,
    verbose_option,
)
from refinenet.refiner import WITH_CONFIDENCE

if TYPE_CHECKING:
    import numpy as np
    from posecore.bop import ModelInfo
    from posecore.mesh import Mesh, Units

    from refinenet.models.checkpoint import Checkpoint
    from refinenet.tracking.frame_sources import FrameSequence

SHOWN_REASONS = 3


@click.command()
@click.argument("source", type=FILE)
@method_option
@checkpoint_option
@click.option("--out", required=True, type=NEW_FILE, metavar="CSV", help="Poses, a BOP result file.")
@click.option("--init", type=FILE, metavar="CSV", help="BOP result file to start from, and to start again when lost.")
@click.option(
    "--pose", type=FILE, metavar="JSON", help="Start poses as a list of scene_gt.json: obj_id, cam_R_m2c, ..."
)
@click.option("--split", metavar="NAME", help="Split of a BOP dataset. [test, val, train_pbr, train or the only one]")
@click.option(
    "--scene", type=click.IntRange(0), help="Scene of a BOP dataset; of images in the result file. [only one, 0]"
)
@click.option("--camera", type=FILE, metavar="JSON", help="Camera of images or a video: a BOP camera.json.")
@click.option(
    "--mesh", "mesh_files", type=FILE, multiple=True, metavar="FILE",
    help="Mesh for images or a video; obj_000005.ply is object 5, else the only one known. Repeatable.",
)  # fmt: skip
@click.option("--units", type=click.Choice(["mm", "cm", "m"]), default="mm", help="Unit of --mesh.")
@click.option("--object", "objects", type=int, multiple=True, help="Track only this object. Repeatable. [all]")
@iterations_option
@click.option("--motion-model", is_flag=True, help="Expect constant velocity, not the place of the last frame.")
@click.option(
    "--sure", type=click.FloatRange(0, 1), help="Confidence of a pose that fits. [0.35, learned 0.5, search 0.4]"
)
@click.option("--found", type=click.FloatRange(0, 1), help="Confidence of a pose that is believed. [0.2, search 0.4]")
@click.option("--patience", type=click.IntRange(1), default=5, help="Frames without a pose until an object is lost.")
@click.option(
    "--depth-step", type=click.FloatRange(0, 0.5, max_open=True),
    help="Also try each pose nearer and farther by this share of its depth; 0 is faster, and depth may drift. "
    "[0.02; 0 for preset flow and for a method without confidences]",
)  # fmt: skip
@click.option("--video", type=NEW_FILE, metavar="FILE", help="Write a video (.mp4, .avi) with contours and states.")
@click.option("--fps", type=click.FloatRange(0.1), default=30.0, help="Frames a second of --video.")
@click.option("--name", help="Method's name in the report. [the preset and the checkpoint's step]")
@device_option
@threads_option
@other_mesh_option
@quiet_option
@verbose_option
def track(
    source: Path,
    method: str,
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
    sure: float | None,
    found: float | None,
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
    """Track objects through SOURCE: a scene of a BOP dataset, a folder of images, or a video file.

    Each frame starts from the poses of the one before. An object is tracking, uncertain, or lost; one that is lost has
    no pose in the result file until one of --init or --pose fits, or it is found again where it was.

    \b
    refinenet track choi --scene 1 --checkpoint best.safetensors --init start.csv --out results/track.csv
    refinenet track choi --scene 1 --method edge-icp --init start.csv --out results/edges.csv
    refinenet track clip.mp4 --camera camera.json --mesh part.ply --pose start.json --checkpoint best.safetensors \\
        --out track.csv --video annotated.mp4
    """
    require_fit(method, checkpoint)
    if video is None:
        require_used("without --video", "fps")
    if method not in WITH_CONFIDENCE:
        require_used(f"for --method {method}, which tells no confidence", "sure", "found", "depth_step")
    if (init is None) == (pose is None):
        raise click.UsageError("give either --init or --pose: where the objects are at the start")
    require_apart(
        {"SOURCE": source, "--init": init, "--pose": pose, "--camera": camera, "--checkpoint": checkpoint},
        {"--out": out, "--video": video},
    )
    import torch
    from posecore.bop import write_results
    from posecore.files import require_writable

    from refinenet import __version__
    from refinenet.models import checkpoint as checkpoints
    from refinenet.refine.network_refiner import Refiner
    from refinenet.refiner import PoseRefiner, make_baseline
    from refinenet.tracking.frame_sources import BopScene, open_sequence
    from refinenet.tracking.run import TrackLog, track_sequence
    from refinenet.tracking.state import TrackingConfig
    from refinenet.tracking.tracker import Tracker, usual_config

    if threads:
        torch.set_num_threads(threads)
    loaded = None if checkpoint is None else checkpoints.load(checkpoint)
    sequence = open_sequence(source, split=split, scene=scene, camera=camera)
    starts = _Starts(init, pose, sequence, objects)
    meshes, infos = _models(sequence, mesh_files, units, loaded, starts.obj_ids)
    for path in filter(None, (out, video)):
        require_writable(path)
    log, stopped = TrackLog(), None
    refiner: PoseRefiner
    if loaded is None:
        refiner = make_baseline(method, meshes, iterations, min_confidence=found)
    else:
        refiner = Refiner(loaded, meshes, iterations=iterations, device=device, allow_other_mesh=allow_other_mesh)
    with closing(refiner), progress_bar(quiet) as bar:
        usual = usual_config(refiner)
        config = TrackingConfig(
            sure=usual.sure if sure is None else sure,
            found=usual.found if found is None else found,
            patience=patience,
            depth_step=usual.depth_step if depth_step is None else depth_step,
        )
        symmetries = {i: info for i, info in infos.items() if info.is_symmetric}
        tracker = Tracker(refiner, starts.obj_ids, config, symmetries=symmetries, motion=motion_model)
        task = bar.add_task("frames", total=len(sequence) or None)
        try:
            track_sequence(
                sequence, tracker, starts.offered, log, meshes=meshes, video=video, fps=fps,
                on_frame=lambda: bar.advance(task),
            )  # fmt: skip
        except (KeyboardInterrupt, PoseError, OSError) as error:
            stopped = error
    if stopped is not None and not log.frames:
        end_early(stopped, None)
    sidecar: dict[str, Any] = {"method": name or f"{refiner.name}, tracking"}
    if isinstance(sequence, BopScene):
        sidecar |= {"dataset": str(sequence.dataset.root.resolve()), "split": sequence.dataset.split}
    if loaded is not None:
        sidecar |= {"checkpoint": loaded.path.name, "checkpoint_sha256": loaded.sha256}
    sidecar |= {
        "settings": {
            "refinenet": __version__, **refiner.settings, "motion_model": motion_model, "sure": config.sure,
            "found": config.found, "patience_frames": config.patience, "depth_step": config.depth_step,
        },
        "init": (init or pose or source).name,
        "states": {str(state): count for state, count in log.states.items()},
        "resets": log.resets,
        "misses": log.misses,
    }  # fmt: skip
    if stopped is not None:
        sidecar["not_reached"] = max(len(sequence) - log.frames, 1)  # of a video the length is not known
    write_results(out, log.estimates, sidecar)
    counts = ", ".join(f"{count} {state}" for state, count in log.states.items())
    click.echo(f"{out}: {log.frames} frames, {counts}; {len(log.resets)} starts from a given pose")
    if log.frames:
        click.echo(
            f"{log.frames / log.tracking_s:.1f} frames/s tracking, "
            f"{log.frames / log.total_s:.1f} with reading{' and drawing' if video else ''}"
        )
    for why, count in Counter(miss["why"] for miss in log.misses).most_common(SHOWN_REASONS):
        click.echo(f"No pose, {count} times: {why}", err=True)
    if stopped is not None:
        end_early(stopped, f"what was tracked is in {out}")


class _Starts:
    """Start poses of a sequence: those of a result file at their images, those of a pose file at any."""

    def __init__(
        self, init: Path | None, pose: Path | None, sequence: "FrameSequence", objects: tuple[int, ...]
    ) -> None:
        from posecore.bop import read_results

        self._always: dict[int, list[np.ndarray]] = {}
        self._at: dict[int, dict[int, list[np.ndarray]]] = {}
        if init is not None:
            for start in read_results(init):
                if start.scene_id == sequence.scene_id and (not objects or start.obj_id in objects):
                    self._at.setdefault(start.im_id, {}).setdefault(start.obj_id, []).append(start.T_cam_obj)
        elif pose is not None:
            for obj_id, T in _read_poses(pose):
                if not objects or obj_id in objects:
                    self._always.setdefault(obj_id, []).append(T)
        self.obj_ids = sorted({i for known in (self._always, *self._at.values()) for i in known})
        missing = sorted(set(objects) - set(self.obj_ids))
        if missing or not self.obj_ids:
            which = f" of object {', '.join(map(str, missing))}" if missing else ""
            where, change = (f" for scene {sequence.scene_id}", "--scene or --object") if init else ("", "--object")
            todo = f"change {change}" if objects or init else "list where the objects are at the start"
            raise ConfigError(f"{init or pose}: no pose{which}{where}; {todo}")

    def offered(self, number: int) -> "dict[int, list[np.ndarray]]":
        """Poses for a frame, by object."""
        return self._at.get(number, {}) if self._at else self._always


def _read_poses(file: Path) -> "list[tuple[int, np.ndarray]]":
    from posecore.bop.annotations import ground_truth
    from posecore.bop.jsonfile import read_json

    from refinenet.refiner import SUSPICIOUS_M

    poses = [ground_truth(entry, i, None, f"{file}, entry {i}") for i, entry in enumerate(read_json(file, list))]
    nearest_m = min((abs(float(pose.T_cam_obj[2, 3])) for pose in poses), default=SUSPICIOUS_M)
    if nearest_m < SUSPICIOUS_M:
        raise ConfigError(
            f"{file}: a t_z of {1e3 * nearest_m:.4g} looks like metres; "
            "cam_t_m2c is in millimetres, multiply it by 1000"
        )
    return [(pose.obj_id, pose.T_cam_obj) for pose in poses]


def _models(
    sequence: "FrameSequence", files: tuple[Path, ...], units: "Units", loaded: "Checkpoint | None", obj_ids: list[int]
) -> "tuple[dict[int, Mesh], dict[int, ModelInfo]]":
    """Meshes and symmetries of the objects: the dataset's, or files with a models_info.json beside them."""
    from posecore.bop.jsonfile import read_json
    from posecore.bop.models_info import load_model_info
    from posecore.mesh import load_mesh

    from refinenet.tracking.frame_sources import BopScene

    if isinstance(sequence, BopScene):
        if files or units != "mm":
            raise ConfigError(
                "--mesh and --units are for images and videos; a BOP dataset brings its own models, in mm"
            )
        infos = sequence.dataset.models_info
        return {i: sequence.dataset.mesh(i) for i in obj_ids}, {i: infos[i] for i in obj_ids if i in infos}
    known = obj_ids if loaded is None else sorted(map(int, loaded.provenance.objects))
    meshes: dict[int, Mesh] = {}
    symmetric: dict[int, ModelInfo] = {}
    for file in files:
        numbered = re.fullmatch(r"obj_(\d+)", file.stem)
        if numbered is None and len(known) > 1:
            some, who = ", ".join(map(str, known)), "start poses are of" if loaded is None else "the checkpoint knows"
            raise ConfigError(f"{file}: {who} objects {some}; name the file obj_000001.ply to say which")
        obj_id = int(numbered[1]) if numbered else known[0]
        meshes[obj_id] = load_mesh(file, units=units)
        info_file = file.with_name("models_info.json")
        listed = read_json(info_file) if info_file.is_file() else {}
        entry = listed.get(str(obj_id)) or listed.get(file.stem)  # by number as in BOP, or by the mesh's name
        if entry is not None:
            symmetric[obj_id] = load_model_info(entry, f"{info_file}, object {obj_id}")
    missing = [i for i in obj_ids if i not in meshes]
    if missing:
        raise ConfigError(f"object {missing[0]} has a start pose and no mesh; give its file with --mesh")
    return {i: meshes[i] for i in obj_ids}, symmetric
