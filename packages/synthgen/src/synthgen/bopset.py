"""Whole camera images in BOP's layout: data to try a refiner on, with ground truth."""

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from posecore import config as config_tools
from posecore.bop import BopWriter, GroundTruth, ModelInfo, Target, write_models, write_targets
from posecore.errors import ConfigError, DatasetError, StorageError
from posecore.files import storage_error, write_atomic
from posecore.mesh import Mesh

from synthgen.config import SynthConfig
from synthgen.dataset import versions
from synthgen.pair import PairMaker, limit_threads
from synthgen.target import make_target

SPLIT = "test"
SCENE_ID = 1
CARD = "synthgen.json"
_FARTHEST_STEP = 65535


def write_dataset(
    root: str | Path,
    config: SynthConfig,
    meshes: Mapping[int, Mesh],
    frames: int,
    *,
    photos: Sequence[str] = (),
    infos: Mapping[int, ModelInfo] | None = None,
    on_frame: Callable[[int], None] = lambda im_id: None,
) -> None:
    """Render a BOP dataset of one scene; a folder that holds some of its frames already is continued.

    Frames follow the same configuration as training pairs (camera, distance, lights, occluders, backgrounds) but no
    frame is a scene of a pair.

    Args:
        root: Dataset folder.
        config: Recipe; its patch and hypothesis settings are without effect.
        meshes: Objects by id; each frame shows one.
        frames: Number of images.
        photos: Background photographs.
        infos: Symmetries for models_info.json.
        on_frame: Called after each frame is on disk.

    Raises:
        ConfigError: No frames wanted.
        DatasetError: The folder holds something else.
        StorageError: The folder cannot be written.
    """
    if frames < 1:
        raise ConfigError(f"--frames {frames}: expected at least 1 frame")
    folder = Path(root)
    _claim(folder, config, meshes, frames, len(photos))
    write_models(folder, meshes, infos)
    limit_threads(0)
    targets = [make_target(obj_id, mesh, config) for obj_id, mesh in sorted(meshes.items())]
    farthest_m = max(t.distance_m[1] + 5 * t.mesh.diameter_m for t in targets)
    depth_scale = 0.1 if farthest_m < 0.1e-3 * _FARTHEST_STEP else 1.0
    maker = PairMaker(config, targets, photos)
    try:
        with BopWriter(folder, SPLIT, SCENE_ID, depth_scale=depth_scale) as writer:
            done = set(writer.im_ids)
            for im_id in range(frames):
                if im_id not in done:
                    _add_frame(writer, maker, im_id)
                on_frame(im_id)
    finally:
        maker.close()
    write_targets(folder, SPLIT, _targets(folder))


def _add_frame(writer: BopWriter, maker: PairMaker, im_id: int) -> None:
    draw, rendered, image = maker.render_frame(im_id)
    # Blender's index layer and the rasteriser's silhouette differ by single pixels: the visible part is kept inside
    margin = max(maker.camera.width_px, maker.camera.height_px) // 4
    silhouette = maker.silhouette_depth(draw.target.obj_id, draw.T_cam_obj, margin) > 0
    inside = silhouette[margin:-margin, margin:-margin]
    truth = GroundTruth(obj_id=draw.target.obj_id, T_cam_obj=draw.T_cam_obj)
    visible = (rendered.index == 0) & inside
    writer.add_frame(
        im_id,
        image,
        rendered.depth_m,
        maker.camera,
        [truth],
        [silhouette],
        [visible],
        mask_origin_px=(margin, margin),
    )


def _targets(folder: Path) -> list[Target]:
    truth = json.loads((folder / SPLIT / f"{SCENE_ID:06d}" / "scene_gt.json").read_text(encoding="utf-8"))
    return [
        Target(scene_id=SCENE_ID, im_id=int(im_id), obj_id=entry["obj_id"])
        for im_id, gts in truth.items()
        for entry in gts
    ]


def _claim(folder: Path, config: SynthConfig, meshes: Mapping[int, Mesh], frames: int, photos: int) -> None:
    """Write what the dataset is, or check that the folder holds this very dataset."""
    card: dict[str, Any] = {
        "frames": frames,
        "photos": photos,
        "objects": {str(i): {"name": Path(m.path).name, "sha256": m.sha256} for i, m in sorted(meshes.items())},
        "config": config_tools.to_dict(config),
    }
    file = folder / CARD
    try:
        if file.is_file():
            found = json.loads(file.read_text(encoding="utf-8"))
            different = [k for k in card if found.get(k) != json.loads(json.dumps(card[k]))]
            if different:
                raise DatasetError(
                    f"{folder}: holds another dataset (its {', '.join(different)} differ); choose another --out, or "
                    "delete that folder, or start with the same settings to continue it"
                )
            return
        if folder.is_dir() and any(not p.name.endswith(".tmp") for p in folder.iterdir()):
            raise DatasetError(
                f"{folder}: the folder is not empty and holds no dataset of synthgen; choose another --out"
            )
    except StorageError:
        raise
    except OSError as error:
        raise storage_error(folder, error) from error
    except json.JSONDecodeError as error:
        raise DatasetError(f"{file}: is damaged; delete the folder and render it again") from error
    write_atomic(file, (json.dumps(card | {"versions": versions(config)}, indent=2) + "\n").encode())
