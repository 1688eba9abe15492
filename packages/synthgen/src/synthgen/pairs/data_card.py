"""A dataset's card and the files that lie beside its shards."""

import json
from collections.abc import Mapping, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from posecore import config as config_tools
from posecore.bop import ModelInfo, load_models_info, write_models
from posecore.bop.jsonfile import read_json
from posecore.errors import ConfigError, DatasetError
from posecore.mesh import Mesh

from synthgen.config import SynthConfig
from synthgen.draw.target import TargetObject, make_targets
from synthgen.inputs.assets import Assets

# What decides the bytes of a sample beside the project itself.
_PACKAGES = ("synthgen", "posecore", "numpy", "opencv-python-headless", "numcodecs", "moderngl", "trimesh")
UNITS = {"length": "m", "angle": "rad", "image": "px", "transform": "p_cam = T_cam_obj @ p_obj"}
DEPTH_STEPS = 65535  # depth is stored in 16 bits
FINEST_DEPTH_STEP_M = 1e-4


def make_card(config: SynthConfig, n: int, meshes: Mapping[int, Mesh], assets: Assets) -> dict[str, Any]:
    """The data card: nothing in it depends on time, machine or number of workers.

    Raises:
        ConfigError: n is not positive, or the distances do not suit an object's window.
    """
    if n < 1:
        raise ConfigError(f"--n {n}: expected at least 1 sample")
    targets = make_targets(meshes, config)
    camera = config.camera
    return {
        "n": n,
        "shard_size": config.shard_size,
        "patch_px": config.patch_px,
        "contour_points": config.contour_points,
        "depth_step_m": depth_step_m(targets),
        "seed": config.seed,
        "config": config_tools.to_dict(config),
        "objects": {
            str(t.obj_id): {
                "name": t.name,
                "path": f"models/obj_{t.obj_id:06d}.ply",
                "texture": None if t.mesh.texture_rgb is None else f"models/obj_{t.obj_id:06d}.png",
                "sha256": t.mesh.sha256,
                "diameter_m": t.mesh.diameter_m,
                "window_side_px": t.window_side_px,
            }
            for t in targets
        },
        "camera": config_tools.to_dict(camera),
        **assets.card(),
        "units": UNITS,
        "versions": versions(config),
    }


def depth_step_m(targets: Sequence[TargetObject]) -> float:
    """Step that depth is stored in: 0.1 mm, doubled until the deepest scene of the largest object fits."""
    deepest_m = max(t.distance_m[1] + t.reach_m for t in targets)
    step_m = FINEST_DEPTH_STEP_M
    while deepest_m > DEPTH_STEPS * step_m:
        step_m *= 2
    return step_m


def model_files(meshes: Mapping[int, Mesh], infos: Mapping[int, ModelInfo]) -> dict[str, bytes]:
    """The meshes in BOP's layout, as bytes by key, so that a dataset can be trained on without the original files."""
    with TemporaryDirectory() as folder:
        write_models(folder, meshes, infos)
        return {f"models/{p.name}": p.read_bytes() for p in sorted((Path(folder) / "models").iterdir())}


def load_symmetries(path: str | None, meshes: Mapping[int, Mesh]) -> dict[int, ModelInfo]:
    """Symmetries of the objects from a `models_info.json` whose keys are object ids or the meshes' file names.

    Raises:
        DatasetError: The file is missing or broken, or knows none of the objects.
    """
    if path is None:
        return {}
    ids = {str(obj_id): obj_id for obj_id in meshes} | {Path(mesh.path).stem: i for i, mesh in meshes.items()}
    content = read_json(path)
    entries = {str(ids[key]): entry for key, entry in content.items() if key in ids}
    if not entries:
        raise DatasetError(f"{path}: no entry for {', '.join(sorted(ids))}; its keys are {', '.join(content)}")
    with TemporaryDirectory() as folder:
        numbered = Path(folder) / "models_info.json"
        numbered.write_text(json.dumps(entries), encoding="utf-8")
        return load_models_info(numbered)


def estimated_bytes(patch_px: int, contour_points: int, n: int) -> int:
    """Rough size of a dataset on disk without rendering anything; `synthgen.run.estimate` measures.

    `benchmarks/shard_codecs.py` finds 2.2 to 2.3 bytes a patch pixel at 224 px, and 10 a contour point.
    """
    return round(n * (2.3 * patch_px**2 + 20 * contour_points))


def versions(config: SynthConfig) -> dict[str, str]:
    """Versions of what decides the bytes of a render."""
    blender = bool({config.engine, config.hypothesis_engine} & {"cycles", "eevee"})
    return package_versions(("bpy",) if blender else ())


def package_versions(further: Sequence[str] = ()) -> dict[str, str]:
    """Versions of what decides the bytes of a sample."""
    found = {}
    for name in (*_PACKAGES, *further):
        try:
            found[name] = version(name)
        except PackageNotFoundError:  # a checkout on the path
            found[name] = "unknown"
    return found
