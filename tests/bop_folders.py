"""Small BOP datasets in the layouts that exist: plain, of several sensors, in webdataset shards."""

import io
import json
import tarfile
from pathlib import Path

import cv2
import numpy as np
from posecore import se3
from posecore.bop import BopWriter, FrameRecord, GroundTruth, ModelInfo, write_models, write_targets
from posecore.bop.writer import visible_targets
from posecore.camera import Camera
from posecore.mesh import Mesh
from posecore.raster import Instance, Rasteriser
from posecore.symmetry import ContinuousSymmetry

CAMERA = Camera(K=np.array([[160.0, 0, 61.5], [0, 162.0, 44.25], [0, 0, 1]]), width_px=120, height_px=90)


def write_rendered(root: Path, meshes: dict[int, Mesh], symmetric: int, images: tuple[tuple[int, int], ...]) -> Path:
    """A dataset whose images, depth, masks and annotations agree; one object turns freely about z."""
    axis = ContinuousSymmetry((0.0, 0.0, 1.0), (0.0, 0.0, 0.0))
    turning = ModelInfo(diameter_m=meshes[symmetric].diameter_m, symmetries_continuous=(axis,))
    write_models(root, meshes, {symmetric: turning})
    rng = np.random.default_rng(7)
    width, height = CAMERA.width_px, CAMERA.height_px
    with Rasteriser(meshes) as rasteriser:
        for scene_id, im_id in images:
            poses = {
                obj_id: se3.make_T(
                    se3.random_rotation(rng), np.array([0.12 * index - 0.06, 0.01, rng.uniform(0.5, 0.6)])
                )
                for index, obj_id in enumerate(sorted(meshes))
            }
            instances = [Instance(obj_id=obj_id, T_cam_obj=T) for obj_id, T in poses.items()]
            layers = rasteriser.render_scene(instances, CAMERA.K, width, height)
            masks = [rasteriser.render(i.obj_id, CAMERA.K, i.T_cam_obj[None], width, height).mask[0] for i in instances]
            gts = [GroundTruth(obj_id=obj_id, T_cam_obj=T) for obj_id, T in poses.items()]
            visible = [layers.instance == index for index in range(len(gts))]
            with BopWriter(root, "test", scene_id) as writer:
                writer.add_frame(
                    im_id,
                    FrameRecord(
                        rgb=layers.rgb, depth_m=layers.depth_m, camera=CAMERA, gts=gts, masks=masks, masks_visib=visible
                    ),
                )
    scenes = sorted({scene_id for scene_id, _ in images})
    write_targets(root, "test", [target for scene in scenes for target in visible_targets(root, "test", scene)])
    return root


def name_sensor(scene: Path, sensor: str, *, image_folder: str | None = None) -> None:
    """Rename a plain scene's files as a dataset of several sensors has them."""
    for kind in ("camera", "gt", "gt_info"):
        (scene / f"scene_{kind}.json").rename(scene / f"scene_{kind}_{sensor}.json")
    for folder in ("rgb", "depth", "mask", "mask_visib"):
        named = image_folder if folder == "rgb" and image_folder else f"{folder}_{sensor}"
        if (scene / folder).is_dir():
            (scene / folder).rename(scene / named)


def run_lengths(mask: np.ndarray) -> dict[str, object]:
    """A mask as COCO writes it uncompressed: column by column, lengths of off and on in turn."""
    flat = mask.T.reshape(-1)
    changes = np.flatnonzero(np.diff(flat.astype(np.int8))) + 1
    lengths = np.diff([0, *changes, flat.size]).tolist()
    return {"counts": [0, *lengths] if flat[0] else lengths, "size": list(mask.shape)}


def write_shards(root: Path, split: str, out: Path, *, per_shard: int = 2) -> list[Path]:
    """Pack a split's scenes into shards as bop_toolkit's converters do."""
    samples = []
    for scene in sorted((root / split).iterdir()):
        files = {kind: json.loads((scene / f"scene_{kind}.json").read_text()) for kind in ("camera", "gt", "gt_info")}
        for im_id in files["camera"]:
            parts = {f"{kind}.json": json.dumps(content[im_id]).encode() for kind, content in files.items()}
            for layer in ("rgb", "depth"):
                for image in (scene / layer).glob(f"{int(im_id):06d}.*"):
                    parts[layer + image.suffix] = image.read_bytes()
            for kind in ("mask", "mask_visib"):
                masks = [cv2.imread(str(m), -1) > 0 for m in sorted((scene / kind).glob(f"{int(im_id):06d}_*.png"))]
                runs = {str(index): run_lengths(mask) for index, mask in enumerate(masks)}
                parts[f"{kind}.json"] = json.dumps(runs).encode()
            samples.append((f"{scene.name}_{int(im_id):06d}", parts))
    out.mkdir(parents=True, exist_ok=True)
    shards = []
    for start in range(0, len(samples), per_shard):
        shards.append(out / f"shard-{start // per_shard:06d}.tar")
        with tarfile.open(shards[-1], "w") as tar:
            for key, parts in samples[start : start + per_shard]:
                for name, data in parts.items():
                    member = tarfile.TarInfo(f"{key}.{name}")
                    member.size = len(data)
                    tar.addfile(member, io.BytesIO(data))
    return shards
