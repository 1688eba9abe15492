"""Tiny shard datasets made with the rasteriser, so that these tests need neither Blender nor synthgen."""

import json
import shutil
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
import trimesh
from posecore import contour, se3
from posecore.bop import BopWriter, Estimate, FrameRecord, GroundTruth, write_models, write_results
from posecore.bop.models_info import save_models_info
from posecore.camera import Camera, crop_K, intrinsics
from posecore.mesh import Mesh, load_mesh, save_ply
from posecore.raster import Rasteriser
from posecore.shard import ShardWriter
from posecore.window import cut, fixed_side_px, fixed_window
from refinenet.config import load_config
from refinenet.models import checkpoint
from refinenet.models.networks import make_network
from search_models import models_made_once

K = intrinsics(572.4, 573.6, 325.3, 242.0)
WIDTH_PX, HEIGHT_PX = 640, 480


def make_mesh(path: Path) -> Mesh:
    """A box with a tower and a knob, every face coloured: no symmetry in shape or colour."""
    parts = [
        trimesh.creation.box((0.08, 0.05, 0.04)),
        trimesh.creation.box((0.02, 0.02, 0.06), trimesh.transformations.translation_matrix((0.025, 0.01, 0.04))),
        trimesh.creation.icosphere(subdivisions=2, radius=0.015),
    ]
    parts[2].apply_translation((-0.03, -0.01, 0.025))
    whole = trimesh.util.concatenate([part.subdivide() for part in parts])
    soup = whole.vertices[whole.faces].reshape(-1, 3)
    faces = np.arange(len(soup), dtype=np.int32).reshape(-1, 3)
    rgb = np.random.default_rng(5).integers(30, 255, (len(faces) // 4 + 1, 3), dtype=np.uint8)
    colours = np.repeat(np.repeat(rgb, 4, axis=0)[: len(faces)], 3, axis=0)
    normals = np.repeat(whole.face_normals, 3, axis=0)
    save_ply(Mesh(vertices_m=soup, faces=faces, normals=normals, vertex_rgb=colours), path, units="mm")
    return load_mesh(path, units="mm")


def background(rng: np.random.Generator, photos: Sequence[np.ndarray] = ()) -> np.ndarray:
    """A piece of a photograph where there are any, else coloured noise."""
    if not photos:
        coarse = rng.integers(0, 256, (int(rng.integers(3, 24)),) * 2 + (3,), dtype=np.uint8)
        return cv2.resize(coarse, (WIDTH_PX, HEIGHT_PX), interpolation=cv2.INTER_CUBIC)
    photo = photos[int(rng.integers(len(photos)))]
    width = int(rng.integers(min(photo.shape[:2]) // 3, min(photo.shape[:2])))
    y, x = (int(rng.integers(0, size - width + 1)) for size in photo.shape[:2])
    piece = np.rot90(photo[y : y + width, x : x + width], int(rng.integers(4)))
    return cv2.resize(np.ascontiguousarray(piece), (WIDTH_PX, HEIGHT_PX))


def make_sample(
    mesh: Mesh, rasteriser: Rasteriser, side_px: float, patch_px: int, contour_points: int, seed: Sequence[int],
    photos: Sequence[np.ndarray] = (), max_angle_deg: float = 20.0,
) -> dict[str, Any]:  # fmt: skip
    """One pair with all its labels."""
    rng = np.random.default_rng(seed)
    z = mesh.diameter_m * rng.uniform(5, 9)
    t = np.array([rng.uniform(-0.12, 0.12) * z, rng.uniform(-0.1, 0.1) * z, z])
    T = se3.make_T(se3.random_rotation(rng), t)
    guess = se3.perturb(T, np.deg2rad(max_angle_deg) * rng.random(), 0.2 * mesh.diameter_m * rng.random(), rng)
    window = fixed_window(mesh.vertices_m, K, guess, side_px)
    K_patch = crop_K(K, window, patch_px)
    layers = rasteriser.render(1, K_patch, np.stack([T, guess]), patch_px, patch_px)
    assert layers.rgb is not None
    mask = layers.mask
    behind = cut(background(rng, photos), window, patch_px)
    scene = np.where(mask[0][..., None], layers.rgb[0], behind)
    return {
        "scene_rgb": scene,
        "hypothesis_rgb": layers.rgb[1],
        "scene_depth_m": layers.depth_m[0],
        "hypothesis_depth_m": layers.depth_m[1],
        "scene_mask": (mask[0] * np.uint8(7)).astype(np.uint8),
        "scene_contour_cam_m": contour.sample_contour(mask[0], layers.depth_m[0], K_patch, contour_points, rng),
        "hypothesis_contour_cam_m": contour.sample_contour(mask[1], layers.depth_m[1], K_patch, contour_points, rng),
        "scene_distance_px": contour.distance_transform_px(contour.contour_mask(mask[0])),
        "hypothesis_distance_px": contour.distance_transform_px(contour.contour_mask(mask[1])),
        "T_cam_obj": T,
        "T_cam_obj_hypothesis": guess,
        "K": K,
        "K_crop": K_patch,
        "window_px": window.as_array(),
        "visible_fraction": np.float32(1),
        "obj_id": np.int32(1),
        "scene_index": np.int64(seed[-1] // 2),
        "rejected": np.int32(seed[-1] % 2),
    }


def make_dataset(
    folder: Path, mesh: Mesh, n: int, shard_size: int, patch_px: int, contour_points: int = 48, padding: float = 0.6,
    photos: Sequence[np.ndarray] = (), max_angle_deg: float = 20.0,
) -> Path:  # fmt: skip
    """A complete dataset of one object, two samples a scene."""
    side_px = fixed_side_px(mesh.vertices_m, K, 5 * mesh.diameter_m, padding)
    card: Mapping[str, Any] = {
        "n": n, "shard_size": shard_size, "patch_px": patch_px, "contour_points": contour_points, "seed": 0,
        "depth_step_m": 1e-4,
        "config": {},
        "camera": {"width_px": 640, "height_px": 480, "fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]},
        "objects": {
            "1": {
                "name": "thing", "path": "models/obj_000001.ply", "sha256": "",
                "diameter_m": mesh.diameter_m, "window_side_px": side_px,
            }
        },
    }  # fmt: skip
    writer = ShardWriter.create(str(folder), card)
    save_ply(mesh, folder / "models" / "obj_000001.ply", units="mm")
    save_models_info(folder / "models" / "models_info.json", {1: mesh}, {})
    with Rasteriser({1: mesh}) as rasteriser:
        for shard in range(-(-n // shard_size)):
            samples = [
                make_sample(mesh, rasteriser, side_px, patch_px, contour_points, (7, i), photos, max_angle_deg)
                for i in range(shard * shard_size, min(n, (shard + 1) * shard_size))
            ]
            writer.commit(writer.encode(shard, {key: np.stack([s[key] for s in samples]) for key in samples[0]}))
    return folder


@pytest.fixture(scope="session", autouse=True)
def _models_made_once() -> Iterator[None]:
    with models_made_once():
        yield


@pytest.fixture(scope="session")
def mesh(tmp_path_factory: pytest.TempPathFactory) -> Mesh:
    """The coloured test object."""
    return make_mesh(tmp_path_factory.mktemp("mesh") / "thing.ply")


@pytest.fixture(scope="session")
def tug(tug_ply: Path) -> Mesh:
    """The example object."""
    return load_mesh(tug_ply)


@pytest.fixture(scope="session")
def dataset(tmp_path_factory: pytest.TempPathFactory, mesh: Mesh) -> Path:
    """48 pairs in 6 shards of 64 px patches."""
    return make_dataset(tmp_path_factory.mktemp("data") / "shards", mesh, 48, 8, 64)


@pytest.fixture(scope="session")
def frame(mesh):
    """An image with two instances, and their poses."""
    rng = np.random.default_rng(0)
    z = 6 * mesh.diameter_m
    truths = np.stack([
        se3.make_T(se3.random_rotation(rng), np.array([x * z, 0.05 * z, z])) for x in (-0.2, 0.22)
    ])  # fmt: skip
    image = background(rng)
    with Rasteriser({1: mesh}) as rasteriser:
        layers = rasteriser.render(1, K, truths, WIDTH_PX, HEIGHT_PX)
    for rgb, mask in zip(layers.rgb, layers.mask, strict=True):
        image[mask] = rgb[mask]
    return image, truths


@pytest.fixture(scope="session")
def trained(mesh, tmp_path_factory):
    """A checkpoint of random weights for object 1."""
    torch.manual_seed(0)
    config = load_config("compact")
    path = tmp_path_factory.mktemp("checkpoint") / "random.safetensors"
    objects = {"1": {"name": "thing", "diameter_m": mesh.diameter_m, "window_side_px": 150.0}}
    provenance = checkpoint.Provenance(
        config=config, step=7, dataset_sha256="0" * 64, objects=objects, camera_fx_px=K[0, 0]
    )
    checkpoint.save(path, make_network(config.network), provenance)
    return path


def starts_of(truths, mesh):
    """Poses near true ones."""
    rng = np.random.default_rng(1)
    return np.stack([se3.perturb(T, np.deg2rad(20), 0.15 * mesh.diameter_m, rng) for T in truths])


def make_bop(root, image, camera, truths, mesh):
    """A BOP dataset of one image."""
    with Rasteriser({1: mesh}) as rasteriser:
        layers = rasteriser.render(1, camera.K, truths, camera.width_px, camera.height_px)
    gts = [GroundTruth(obj_id=1, T_cam_obj=T, visib_fract=1.0, gt_index=i) for i, T in enumerate(truths)]
    writer = BopWriter(root, "test", 1)
    writer.add_frame(
        0,
        FrameRecord(
            rgb=image,
            depth_m=layers.depth_m.max(axis=0),
            camera=camera,
            gts=gts,
            masks=list(layers.mask),
            masks_visib=list(layers.mask),
        ),
    )
    writer.close()
    write_models(root, {1: mesh}, {})


@pytest.fixture
def bop(tmp_path, mesh, frame):
    """A BOP dataset of that image, and start poses with a sidecar; one of them is behind the camera."""
    image, truths = frame
    root = tmp_path / "bop"
    camera = Camera(K=K, width_px=WIDTH_PX, height_px=HEIGHT_PX)
    make_bop(root, image, camera, truths, mesh)
    starts = [*starts_of(truths, mesh), se3.make_T(np.eye(3), np.array([0, 0, -0.5]))]
    estimates = [Estimate(scene_id=1, im_id=0, obj_id=1, score=0.9, T_cam_obj=T) for T in starts]
    sidecar = {"dataset": str(root), "method": "initial", "perturbation": {"rows": [{"line": 2}]}}
    write_results(tmp_path / "start.csv", estimates, sidecar)
    return root, tmp_path / "start.csv"


@pytest.fixture
def two_images(bop, tmp_path):
    """A dataset that has that image a second time, darker, and four start poses, the first of them in the second image;
    and that image's file."""
    root, start = bop
    two = tmp_path / "two"
    shutil.copytree(root, two)
    for name in ("scene_camera.json", "scene_gt.json"):
        file = two / "test" / "000001" / name
        content = json.loads(file.read_text())
        file.write_text(json.dumps({**content, "1": content["0"]}))
    (picture,) = (two / "test" / "000001" / "rgb").iterdir()
    second = picture.with_stem("000001")
    cv2.imwrite(str(second), cv2.imread(str(picture)) // 2)
    lines = start.read_text().splitlines()
    start.write_text("\n".join([lines[0], lines[1].replace("1,0,1", "1,1,1", 1), *lines[1:]]) + "\n")
    return two, start, second


@pytest.fixture
def cli():
    """Run the command in this process."""
    from click.testing import CliRunner
    from refinenet.cli import main

    return lambda *arguments: CliRunner().invoke(main, [str(argument) for argument in arguments])
