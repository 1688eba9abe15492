"""Cycles and the rasteriser draw a mesh file alike: colours of flat lit patches, and shading under a lamp."""

from collections.abc import Iterator, Mapping

import numpy as np
import pytest
from blender_scenes import MATT, at, box, scene_of
from mesh_cases import CASES
from posecore import se3
from posecore.camera import Camera, intrinsics
from posecore.mesh import Mesh, load_mesh
from synthgen.engine import Engine
from synthgen.engines.make import make_engine
from synthgen.image.sensor import display_from_linear
from synthgen.scene import Light, SceneObject

pytestmark = [pytest.mark.blender, pytest.mark.slow]

CAMERA = Camera(K=intrinsics(160.0, 160.0, 40.0, 20.0), width_px=80, height_px=40)
TOWARDS = (np.pi, 0.0, 0.0)
"""Turns the squares, which face +z, towards the camera."""
CORNERS = np.array([[x, y, z] for x in (-50, 50) for y in (-50, 50) for z in (-50, 50)])
QUADS = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
INWARD = QUADS[:, ::-1]
CUBES = {
    "outward": QUADS,
    "inward": INWARD,
    "doubled": np.concatenate([QUADS, INWARD]),
    "doubled, inward first": np.concatenate([INWARD, QUADS]),
}
"""Cubes of eight vertices without normals."""


@pytest.fixture(scope="module")
def meshes(tmp_path_factory) -> Mapping[str, Mesh]:
    """Meshes by name; `box` is a cube with the normals of its faces."""
    loaded = {"box": box(0.1, 0.1, 0.1)}
    for name, case in CASES.items():
        loaded[name] = load_mesh(case.write(tmp_path_factory.mktemp("mesh")))
    for name, polygons in CUBES.items():
        file = tmp_path_factory.mktemp("cube") / "cube.obj"
        lines = [f"v {x} {y} {z}" for x, y, z in CORNERS]
        lines += [*("f " + " ".join(map(str, polygon)) for polygon in (polygons + 1).tolist())]
        file.write_text("\n".join(lines) + "\n")
        loaded[name] = load_mesh(file)
    return loaded


@pytest.fixture(scope="module")
def engines(meshes) -> Iterator[Mapping[str, Engine]]:
    made = {name: make_engine(name, threads=2) for name in ("raster", "cycles")}
    for engine in made.values():
        engine.load(dict(enumerate(meshes.values())))
    yield made
    for engine in made.values():
        engine.close()


def shown(engine, meshes, name, T, **settings):
    key = list(meshes).index(name)
    return engine.render(scene_of(SceneObject(mesh_key=key, T_cam_obj=T, material=MATT), **settings))


@pytest.mark.parametrize("name", CASES)
def test_both_squares_have_the_colours_of_their_file_in_both_engines(engines, meshes, name):
    case = CASES[name]
    for engine in engines.values():
        T = at(0, 0, 0.2, TOWARDS)
        layers = shown(engine, meshes, name, T, camera=CAMERA, region_px=(0, 0, 80, 40), samples=8)
        rgb = 255 * display_from_linear(layers.rgb_linear)
        patches = [rgb[18:23, column - 2 : column + 3].mean(axis=(0, 1)) for column in (24, 56)]
        np.testing.assert_allclose(patches, [case.left, case.right], atol=4, err_msg=engine.name)


@pytest.mark.parametrize("name", CUBES)
def test_a_lit_cube_without_normals_looks_like_one_with_flat_normals(engines, meshes, name):
    """Whichever way its faces point, and whether or not they are doubled."""
    rotation = se3.rotation_from_rotvec(np.array([0.6, 0.7, 0.1]))
    T = se3.make_T(rotation, np.array([0.0, 0.0, 0.4]))
    lamp = Light(kind="sun", direction_cam=(0.3, -0.5, -1.0), strength=2.0)
    for engine in engines.values():
        settings = {"lights": (lamp,), "ambient_rgb": (0.0, 0.0, 0.0), "samples": 32}
        pictures = [shown(engine, meshes, key, T, **settings).rgb_linear for key in ("box", name)]
        grey = [(128, 160)[i] / 255 for i in range(2)]
        linear = [((value + 0.055) / 1.055) ** 2.4 for value in grey]
        faces = 0
        for axis, sign in ((0, 1), (1, 1), (2, 1), (0, -1), (1, -1), (2, -1)):
            middle = T[:3, 3] + 0.05 * sign * rotation[:, axis]
            if sign * rotation[:, axis] @ middle >= -0.02:  # seen from behind, or at a glancing angle
                continue
            u, v = np.rint(128 * middle[:2] / middle[2] + 32).astype(int)
            reference, patch = (p[v - 2 : v + 3, u - 2 : u + 3] / own for p, own in zip(pictures, linear, strict=True))
            np.testing.assert_allclose(patch, reference, atol=0.05, err_msg=f"{engine.name}, face {sign * (axis + 1)}")
            faces += patch.mean() > 0.1
        assert faces >= 2
