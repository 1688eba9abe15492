"""Data cards of pair datasets, rendered or cut from images, and the model files beside their shards."""

import json
from collections.abc import Mapping, Sequence
from importlib.metadata import PackageNotFoundError
from importlib.metadata import version as package_version
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from posecore import config as config_tools
from posecore.bop import BopDataset, ModelInfo, write_models
from posecore.errors import ConfigError
from posecore.mesh import Mesh
from posecore.raster.selection import MAX_ERROR_PX, RMS_ERROR_PX, SPACING_PX
from posecore.shard import GROUP, ShardWriter
from posecore.shard.fields import schema
from posecore.shard.layout import check_same_card, read_card
from posecore.store import open_store
from posecore.text import printable

from synthgen.config import CutConfig, SynthConfig, migrate
from synthgen.draw.target import TargetObject, make_targets
from synthgen.inputs.assets import Assets
from synthgen.pairs.cut_plan import Plan

UNITS = {"length": "m", "angle": "rad", "image": "px", "transform": "p_cam = T_cam_obj @ p_obj"}
DEPTH_STEPS = 65535  # depth is stored in 16 bits
USUAL_DEPTH_STEP_M = 1e-4
DEPTH_STEPS_A_DIAMETER = 200  # at least, where 16 bits reach that far
_PACKAGES = ("synthgen", "posecore", "numpy", "opencv-python-headless", "numcodecs", "moderngl", "trimesh")
"""Packages whose version may change a sample's bytes."""
_CAMERA_PX = 1e-6
"""Cameras whose intrinsics differ by less are the same."""


def rendered_card(config: SynthConfig, n: int, meshes: Mapping[int, Mesh], assets: Assets) -> dict[str, Any]:
    """Data card of rendered pairs, independent of time, machine and number of workers.

    Raises:
        ConfigError: n is not positive, or the distances do not suit an object's window.
    """
    if n < 1:
        raise ConfigError(f"--n {n}: expected at least 1 sample")
    targets = make_targets(meshes, config)
    return {
        "n": n,
        "shard_size": config.shard_size,
        "patch_px": config.patch_px,
        "contour_points": config.contour_points,
        "depth_step_m": depth_step_m(targets),
        "seed": config.seed,
        "config": config_tools.to_dict(config),
        "objects": {str(t.obj_id): _object_entry(t.obj_id, t.mesh, t.window_side_px) for t in targets},
        "camera": config_tools.to_dict(config.camera),
        **assets.card(),
        **_detail((*meshes.values(), *assets.occluders)),
        "units": UNITS,
        "versions": versions(config),
    }


def _detail(meshes: Sequence[Mesh]) -> dict[str, Any]:
    """Errors that levels of detail may make in a render; nothing where every mesh is drawn in full."""
    if not any(mesh.levels for mesh in meshes):
        return {}
    return {"detail": {"rms_error_px": RMS_ERROR_PX, "max_error_px": MAX_ERROR_PX, "spacing_px": SPACING_PX}}


def cut_card(dataset: BopDataset, plan: Plan, config: CutConfig, *, drawn: bool = True) -> dict[str, Any]:
    """Data card of pairs cut from images, independent of time and machine.

    Args:
        dataset: Images.
        plan: Pairs to cut.
        config: Settings of the cut.
        drawn: Whether hypotheses were drawn, or read from a result file.
    """
    camera = plan.images[0].camera
    smallest_m = min(mesh.diameter_m for mesh in plan.meshes.values())
    deepest_m = max(
        float(dataset.mesh(obj_id).center_cam_m(T)[2]) + dataset.mesh(obj_id).diameter_m
        for image in plan.images
        for obj_id, T in (
            *((gt.obj_id, gt.T_cam_obj) for gt in image.annotated),
            *((pair.gt.obj_id, pair.T_cam_obj_hypothesis) for pair in image.pairs),
        )
    )
    shared = all(np.abs(image.camera.K - camera.K).max() < _CAMERA_PX for image in plan.images)
    return {
        "n": plan.n,
        "shard_size": config.shard_size,
        "patch_px": config.patch_px,
        "contour_points": config.contour_points,
        "depth_step_m": _depth_step_m(deepest_m, smallest_m),
        "seed": config.seed,
        "source": {
            "dataset": printable(dataset.name),
            "split": printable(dataset.split),
            "images": len(plan.images),
            "hypotheses": "drawn" if drawn else "given",
            "sha256": plan.digest,
            "left_out": dict(plan.left_out),
        },
        "cut": config_tools.to_dict(config),
        "windows": config.window,
        "objects": {str(i): _object_entry(i, mesh, plan.windows_px[i]) for i, mesh in plan.meshes.items()},
        "camera": {
            "width_px": camera.width_px,
            "height_px": camera.height_px,
            "fx": float(camera.K[0, 0]),
            "fy": float(camera.K[1, 1]),
            "cx": float(camera.K[0, 2]),
            "cy": float(camera.K[1, 2]),
            "shared": shared,
        },
        "units": UNITS,
        "versions": package_versions(),
    }


def _object_entry(obj_id: int, mesh: Mesh, window_side_px: float) -> dict[str, Any]:
    return {
        "name": printable(Path(mesh.path).name),
        "path": f"models/obj_{obj_id:06d}.ply",
        "texture": None if mesh.texture_rgb is None else f"models/obj_{obj_id:06d}.png",
        "sha256": mesh.sha256,
        "diameter_m": mesh.diameter_m,
        "window_side_px": window_side_px,
    }


def migrated_card(card: Mapping[str, Any]) -> dict[str, Any]:
    """A stored data card with today's configuration keys, its own and those of merged parts."""
    current = dict(card)
    for key in ("config", "cut"):
        if isinstance(card.get(key), Mapping):
            current[key] = migrate(card[key])
    if "merged" in card:
        current["merged"] = [{**part, "card": migrated_card(part["card"])} for part in card["merged"]]
    return current


def create_writer(url: str, card: Mapping[str, Any]) -> ShardWriter:
    """Create a dataset, or reopen the one with the same card; an earlier version's dataset keeps its stored card.

    Raises:
        ShardError: The folder holds another dataset; the message has the first key that differs.
        StorageError: The folder cannot be read or written.
    """
    group = open_store(url).get(GROUP)
    if group is None:
        return ShardWriter.create(url, card)
    stored = read_card(url, group)
    name, version = schema()
    same = json.loads(json.dumps({"schema": name, "schema_version": version, **card}))
    check_same_card(url, migrated_card(stored), migrated_card(same))
    return ShardWriter.create(url, stored)


def depth_step_m(targets: Sequence[TargetObject]) -> float:
    """Depth quantisation of the deepest scene of any object, metres."""
    deepest_m = max(t.distance_m[1] + t.reach_m for t in targets)
    return _depth_step_m(deepest_m, min(t.mesh.diameter_m for t in targets))


def _depth_step_m(deepest_m: float, smallest_m: float) -> float:
    """0.1 mm, doubled until 16 bits reach the largest depth, or halved until an object is 200 steps wide."""
    step_m = USUAL_DEPTH_STEP_M
    while deepest_m > DEPTH_STEPS * step_m:
        step_m *= 2
    while smallest_m < DEPTH_STEPS_A_DIAMETER * step_m and deepest_m <= DEPTH_STEPS * step_m / 2:
        step_m /= 2
    return step_m


def model_files(meshes: Mapping[int, Mesh], infos: Mapping[int, ModelInfo]) -> dict[str, bytes]:
    """Meshes and `models_info.json` in BOP's layout, as bytes by key: training then needs no original files."""
    with TemporaryDirectory() as folder:
        write_models(folder, meshes, infos)
        return {f"models/{p.name}": p.read_bytes() for p in sorted((Path(folder) / "models").iterdir())}


def estimated_bytes(patch_px: int, contour_points: int, n: int) -> int:
    """Rough size of n pairs on disk, without rendering any; `synthgen.run.estimate` measures.

    `benchmarks/shard_codecs.py` finds 2.2 to 2.3 bytes a patch pixel at 224 px, and 10 a contour point.
    """
    return round(n * (2.3 * patch_px**2 + 20 * contour_points))


def versions(config: SynthConfig) -> dict[str, str]:
    """Versions of the packages that decide a render's bytes."""
    blender = bool({config.engine, config.hypothesis_engine} & {"cycles", "eevee"})
    return package_versions(("bpy",) if blender else ())


def package_versions(further: Sequence[str] = ()) -> dict[str, str]:
    """Versions of the packages that decide a sample's bytes, and of `further` ones."""
    numbers = {}
    for name in (*_PACKAGES, *further):
        try:
            numbers[name] = package_version(name)
        except PackageNotFoundError:  # a checkout on the path
            numbers[name] = "unknown"
    return numbers
