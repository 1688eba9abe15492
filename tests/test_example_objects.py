"""The example objects are what their script makes, and have the symmetry that they are there for."""

import importlib.util
import json
import sys
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import trimesh
from posecore.mesh import Mesh, load_mesh
from posecore.se3 import rotation_from_rotvec
from scipy.spatial import cKDTree

FOLDER = Path(__file__).resolve().parent.parent / "examples" / "objects"
NAMES = ("tug", "bobbin")


@cache
def script():
    spec = importlib.util.spec_from_file_location("make_objects", FOLDER / "make_objects.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules["make_objects"] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("name", NAMES)
def test_file_is_what_the_script_makes(name: str) -> None:
    made = script().mesh_of(getattr(script(), f"{name}_parts")())
    kept = load_mesh(FOLDER / f"{name}.ply")
    np.testing.assert_allclose(kept.vertices_m, made.vertices_m, atol=1e-7)
    np.testing.assert_array_equal(kept.faces, made.faces)
    np.testing.assert_array_equal(kept.vertex_rgb, made.vertex_rgb)
    np.testing.assert_allclose(kept.normals, made.normals, atol=1e-3)


@pytest.mark.parametrize("name", NAMES)
def test_solids_are_closed_centred_and_as_big_as_declared(name: str) -> None:
    mesh = load_mesh(FOLDER / f"{name}.ply")
    points, index = np.unique(np.round(mesh.vertices_m, 7), axis=0, return_inverse=True)
    solid = trimesh.Trimesh(points, index.reshape(-1)[mesh.faces], process=False)
    assert solid.is_watertight
    assert solid.volume > 0
    np.testing.assert_allclose(mesh.center_m, 0.0, atol=1e-7)
    info = json.loads((FOLDER / "models_info.json").read_text())[name]
    assert mesh.diameter_m * 1e3 == pytest.approx(info["diameter"], abs=1e-3)


def turned_misfit(mesh: Mesh, rotvec: tuple[float, float, float]) -> float:
    """Mean distance of the turned points to the nearest one of the same colour, as a share of the diameter."""
    scale = mesh.diameter_m / 255.0  # a full step in one colour channel counts as one diameter
    rgb = mesh.vertex_rgb.astype(np.float64) * scale
    turned = mesh.vertices_m @ rotation_from_rotvec(np.array(rotvec)).T
    distance, _ = cKDTree(np.c_[mesh.vertices_m, rgb]).query(np.c_[turned, rgb])
    return float(distance.mean()) / mesh.diameter_m


def test_bobbin_may_be_turned_about_z_only() -> None:
    bobbin = load_mesh(FOLDER / "bobbin.ply")
    info = json.loads((FOLDER / "models_info.json").read_text())["bobbin"]
    assert info["symmetries_continuous"] == [{"axis": [0, 0, 1], "offset": [0, 0, 0]}]
    assert max(turned_misfit(bobbin, (0.0, 0.0, angle)) for angle in (0.3, 1.7, np.pi)) < 0.02
    assert turned_misfit(bobbin, (np.pi, 0.0, 0.0)) > 0.1


def test_tug_has_no_symmetry() -> None:
    tug = load_mesh(FOLDER / "tug.ply")
    half_turns = [(np.pi, 0.0, 0.0), (0.0, np.pi, 0.0), (0.0, 0.0, np.pi)]
    quarter_turns = [(np.pi / 2, 0.0, 0.0), (0.0, np.pi / 2, 0.0), (0.0, 0.0, np.pi / 2)]
    assert min(turned_misfit(tug, turn) for turn in half_turns + quarter_turns) > 0.05
