"""Damaged mesh and material files: a mesh that can be drawn, or one line."""

import warnings
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mesh_cases import CASES
from posecore.errors import MeshError
from posecore.mesh import Mesh, load_mesh

pytestmark = pytest.mark.slow
fuzz = settings(
    max_examples=60,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
TOKENS = [
    b"nan",
    b"-1",
    b"1e400",
    b"99999999999",
    b"0",
    b"{",
    b"]",
    b'"',
    b"\n",
    b"\0",
    b"\xff",
    b"//",
    b"#",
    b"",
    b"f ",
    b"v ",
]


def use_or_refuse(file: Path) -> None:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            mesh = load_mesh(file)
    except MeshError as error:
        refusal = str(error)
    else:
        refusal = ""
        assert_drawable(mesh)
    assert "\n" not in refusal and len(refusal) < 1000


def assert_drawable(mesh: Mesh) -> None:
    assert np.isfinite(mesh.vertices_m).all() and np.isfinite(mesh.normals).all()
    assert mesh.faces.min() >= 0 and mesh.faces.max() < len(mesh.vertices_m)
    assert mesh.uv is None or np.isfinite(mesh.uv).all()
    assert len(mesh.drawn.faces) == len(mesh.faces)


@pytest.mark.parametrize("name", ["obj tiled", "gltf transform", "glb", "stl VisCAM", "off faces", "ply two textures"])
@fuzz
@given(at=st.floats(0, 1), cut=st.integers(0, 9), token=st.sampled_from(TOKENS), end=st.booleans())
def test_any_damage_to_the_mesh(tmp_path: Path, name: str, at: float, cut: int, token: bytes, end: bool) -> None:
    file = CASES[name].write(tmp_path)
    data = file.read_bytes()
    place = int(at * len(data))
    file.write_bytes(data[:place] + token + (b"" if end else data[place + cut :]))
    use_or_refuse(file)


@fuzz
@given(at=st.floats(0, 1), cut=st.integers(0, 9), token=st.sampled_from(TOKENS))
def test_any_damage_to_the_materials(tmp_path: Path, at: float, cut: int, token: bytes) -> None:
    file = CASES["obj scale and offset"].write(tmp_path)
    data = (tmp_path / "m.mtl").read_bytes()
    place = int(at * len(data))
    (tmp_path / "m.mtl").write_bytes(data[:place] + token + data[place + cut :])
    use_or_refuse(file)
