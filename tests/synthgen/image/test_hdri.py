import math
import os
from dataclasses import replace

import cv2
import numpy as np
import OpenEXR
import pytest
from blender_scenes import MATT, at, scene_of
from posecore.camera import Camera, intrinsics
from posecore.errors import ConfigError
from posecore.mesh import Mesh
from posecore.se3 import random_rotation, rotation_from_rotvec
from synthgen.engines.make import make_engine
from synthgen.image import background, hdri
from synthgen.scene import Background, Environment, SceneObject

WIDE = Camera(K=intrinsics(20.0, 20.0, 32.0, 32.0), width_px=64, height_px=64)  # 116 degrees: it sees well to the sides


def write_hdr(path, column, row, *, sky=0.02, spot=400.0, size_px=(128, 64)):
    """A dim sky with one bright patch, red and blue unequal so that a swap of channels shows."""
    image = np.full((size_px[1], size_px[0], 3), sky, np.float32)
    image[row - 1 : row + 2, column - 1 : column + 2] = spot * np.array([0.25, 0.5, 1.0])  # blue, green, red
    assert cv2.imwrite(str(path), image)
    return str(path)


def direction_of(column, row, size_px=(128, 64)):
    """Where a pixel of a panorama lies: x at the picture's middle, y to its left, z up."""
    azimuth = (0.5 - (column + 0.5) / size_px[0]) * 2 * np.pi
    elevation = (0.5 - (row + 0.5) / size_px[1]) * np.pi
    flat = np.array([np.cos(azimuth), np.sin(azimuth)]) * np.cos(elevation)
    return np.append(flat, np.sin(elevation))


def rotation_to(direction_env, towards_cam):
    """A rotation R_cam_env that turns a direction of the panorama to one of the camera."""
    a, b = (np.asarray(v) / np.linalg.norm(v) for v in (direction_env, towards_cam))
    axis = np.cross(a, b)
    return rotation_from_rotvec(axis / np.linalg.norm(axis) * math.atan2(np.linalg.norm(axis), a @ b))


def ball(radius_m=0.12):
    import trimesh

    solid = trimesh.creation.icosphere(subdivisions=3, radius=radius_m)
    return Mesh(
        vertices_m=np.array(solid.vertices),
        faces=np.array(solid.faces, np.int32),
        normals=np.array(solid.vertex_normals, np.float32),
        vertex_rgb=np.full((len(solid.vertices), 3), 200, np.uint8),
    )


def brightest(image):
    """Centre of the light in an image of positive values, from its middle, in px."""
    weight = image.astype(float).sum(axis=2)
    weight = np.where(weight > 0.7 * weight.max(), weight, 0.0)
    v, u = np.indices(weight.shape) + 0.5
    half = np.array(weight.shape[::-1]) / 2
    return np.array([(u * weight).sum(), (v * weight).sum()]) / weight.sum() - half


@pytest.mark.parametrize("position", [(100, 20), (10, 40), (64, 31)])
def test_the_spot_is_visible_where_the_rotation_puts_it(tmp_path, position):
    path = write_hdr(tmp_path / "spot.hdr", *position)
    for x, y in ((0.0, 0.0), (0.8, 0.1), (-0.3, 0.6)):
        R = rotation_to(direction_of(*position), (x, y, 1.0))
        view = hdri.crop(Environment(path=path, R_cam_env=R, strength=0.1), WIDE.K, (0, 0, 64, 64))
        np.testing.assert_allclose(brightest(view), [20 * x, 20 * y], atol=1.2)
        v, u = np.unravel_index(view.sum(axis=2).argmax(), (64, 64))
        assert view[v, u, 0] >= view[v, u, 2]  # red above blue


def test_upright_panoramas_are_not_mirrored(tmp_path):
    """Looking at the middle of the picture, what is right of it is on the right, and the top is up."""
    path = write_hdr(tmp_path / "spot.hdr", 64 + 8, 32 - 6)
    R_cam_env = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])  # z forward is x, x right is -y
    u, v = brightest(hdri.crop(Environment(path=path, R_cam_env=R_cam_env), WIDE.K, (0, 0, 64, 64)))
    assert u > 5
    assert v < -3


def test_a_crop_goes_on_across_the_seam_and_regions_are_cuts(tmp_path):
    image = np.zeros((64, 128, 3), np.float32)
    image[...] = (0.2 + 0.1 * np.cos(2 * np.pi * (np.arange(128) + 0.5) / 128))[None, :, None]
    cv2.imwrite(str(tmp_path / "smooth.hdr"), image)
    R_cam_env = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]])  # looks at the seam
    environment = Environment(path=str(tmp_path / "smooth.hdr"), R_cam_env=R_cam_env)
    whole = hdri.crop(environment, WIDE.K, (0, 0, 64, 64))
    assert np.abs(np.diff(whole[32, :, 0].astype(int))).max() <= 3
    assert np.array_equal(hdri.crop(environment, WIDE.K, (10, 20, 30, 9)), whole[20:29, 10:40])


def test_lamps_instead_of_a_panorama_have_its_direction_colour_and_power(tmp_path):
    path = write_hdr(tmp_path / "spot.hdr", 40, 20)
    R = random_rotation(np.random.default_rng(1))
    item = SceneObject(mesh_key=1, T_cam_obj=at(0, 0, 0.5))
    scene = scene_of(item, environment=Environment(path=path, R_cam_env=R, strength=2.0), ambient_rgb=(0, 0, 0))
    lit = hdri.with_lamps(scene)
    (sun,) = lit.lights
    assert np.dot(sun.direction_cam, R @ direction_of(40, 20)) > math.cos(math.radians(3))
    np.testing.assert_allclose(np.array(sun.rgb) / sun.rgb[0], [1, 0.5, 0.25], rtol=0.05)
    light = hdri.load(path).light
    elevation = (0.5 - (np.arange(256) + 0.5) / 256) * np.pi
    total = (
        2 * (light * np.cos(elevation)[:, None, None]).mean(axis=1).sum(axis=0) / np.cos(elevation).sum() * 4 * np.pi
    )
    got = np.array(sun.rgb) * sun.strength + 4 * np.pi * np.array(lit.ambient_rgb)
    np.testing.assert_allclose(got, total, rtol=0.03)
    assert lit.environment is None
    assert hdri.with_lamps(replace(scene, environment=None)).lights == ()


def test_unit_level_lights_a_white_world_like_ambient_light(tmp_path):
    cv2.imwrite(str(tmp_path / "white.hdr"), np.full((16, 32, 3), 7.0, np.float32))
    np.testing.assert_allclose(hdri.load(str(tmp_path / "white.hdr")).light, 1.0, atol=0.01)


def test_suns_and_residual_light_every_side_as_the_panorama_does(tmp_path):
    """Irradiance on the six sides of a cube, against the whole panorama's, with more lamps in it than suns."""
    rng = np.random.default_rng(3)
    image = np.full((128, 256, 3), 0.1, np.float32)
    for _ in range(30):
        row, column = rng.integers(4, 70), rng.integers(4, 250)
        image[row : row + 3, column : column + 4] = rng.uniform(5, 60) * rng.uniform(0.3, 1.0, 3)
    cv2.imwrite(str(tmp_path / "lamps.hdr"), image)
    light, split = hdri.load(str(tmp_path / "lamps.hdr")).light, hdri.split_light(str(tmp_path / "lamps.hdr"))
    directions, weights = hdri._sphere(*hdri.LIGHT_SIZE_PX)
    assert len(split.suns) == 8
    assert split.residual.max() < 0.3 * light.max()
    for normal in np.concatenate([np.eye(3), -np.eye(3)]):
        facing = (np.maximum(directions @ normal, 0.0) * weights)[..., None]
        whole = (light * facing).sum(axis=(0, 1))
        got = (split.residual * facing).sum(axis=(0, 1))
        got += sum(irradiance * max(towards @ normal, 0.0) for towards, irradiance, _ in split.suns)
        np.testing.assert_allclose(got, whole, rtol=0.16, atol=0.03 * whole.max())
    left = (split.residual * weights[..., None]).sum(axis=(0, 1)) + sum(sun[1] for sun in split.suns)
    np.testing.assert_allclose(left, (light * weights[..., None]).sum(axis=(0, 1)), rtol=1e-4)


def test_exr_is_read_like_hdr(tmp_path):
    path = write_hdr(tmp_path / "spot.hdr", 30, 20)
    rgb = np.ascontiguousarray(cv2.imread(path, cv2.IMREAD_UNCHANGED)[..., ::-1])
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with OpenEXR.File(header, {"RGB": rgb}) as file:
        file.write(str(tmp_path / "spot.exr"))
    panoramas = hdri.list_hdris(tmp_path)
    assert [p.rsplit(".", 1)[1] for p in panoramas] == ["exr", "hdr"]
    np.testing.assert_allclose(hdri.load(panoramas[0]).light, hdri.load(panoramas[1]).light, rtol=1e-5)


@pytest.mark.parametrize("name", ["broken.hdr", "broken.exr"])
def test_a_broken_panorama_is_named(tmp_path, name):
    write_hdr(tmp_path / "good.hdr", 30, 20)
    (tmp_path / name).write_bytes(b"#?RADIANCE\nnot a picture")
    with pytest.raises(ConfigError, match=rf"{name}: cannot be decoded as an (HDRI|image)"):
        hdri.list_hdris(tmp_path)


def test_folders_without_panoramas_and_wrong_shapes_are_named(tmp_path):
    with pytest.raises(ConfigError, match="no such folder"):
        hdri.list_hdris(tmp_path / "none")
    with pytest.raises(ConfigError, match=r"no panorama in it"):
        hdri.list_hdris(tmp_path)
    cv2.imwrite(str(tmp_path / "square.hdr"), np.ones((32, 32, 3), np.float32))
    with pytest.raises(ConfigError, match=r"square\.hdr: the image is 32 x 32 px"):
        hdri.list_hdris(tmp_path)


def sides_of(engine, path, towards_cam, samples=8):
    """Where the light on a ball comes from, and where the background shows the lamp, from the middle in px."""
    R = rotation_to(direction_of(40, 20), towards_cam)
    scene = scene_of(
        SceneObject(mesh_key=1, T_cam_obj=at(0, 0, 0.5), material=MATT),
        camera=WIDE,
        environment=Environment(path=path, R_cam_env=R),
        ambient_rgb=(0.0, 0.0, 0.0),
        background=Background(kind="environment"),
        samples=samples,
    )
    layers = engine.render(scene)
    lit = layers.rgb_linear * layers.alpha[..., None]
    return brightest(lit), brightest(background.render_background(scene, 64, 64))


def check_sides(engine, path):
    for towards in ((1.0, 0.0, 0.7), (-1.0, 0.0, 0.7), (0.0, 1.0, 0.7), (0.0, -1.0, 0.7)):
        on_ball, behind = sides_of(engine, path, towards)
        axis = int(np.argmax(np.abs(towards[:2])))
        assert np.sign(on_ball[axis]) == np.sign(behind[axis]) == np.sign(towards[axis])
        assert abs(on_ball[axis]) > 1.5
        assert abs(on_ball[1 - axis]) < 0.5 * abs(on_ball[axis])


def test_light_and_background_agree_in_the_raster_engine(tmp_path):
    engine = make_engine("raster")
    engine.load({1: ball()})
    check_sides(engine, write_hdr(tmp_path / "spot.hdr", 40, 20))
    engine.close()


@pytest.mark.slow
@pytest.mark.blender
def test_light_and_background_agree_in_cycles(tmp_path):
    import bpy

    before = [len(x) for x in (bpy.data.worlds, bpy.data.images)]
    engine = make_engine("cycles", threads=1)
    engine.load({1: ball()})
    path = write_hdr(tmp_path / "spot.hdr", 40, 20)
    check_sides(engine, path)
    first, *_, again = [sides_of(engine, p, (0.3, 0.2, -1.0), 2)[0].tolist() for p in (path, path)]
    assert first == again
    for number in range(9):  # more panoramas than are kept
        other = write_hdr(tmp_path / f"other{number}.hdr", 20 + number, 20)
        sides_of(engine, other, (0.3, 0.2, -1.0), 1)
    assert len(bpy.data.worlds) - before[0] == 1 + 8
    assert sides_of(engine, path, (0.3, 0.2, -1.0), 2)[0].tolist() == first  # decoded and uploaded again
    lamps = scene_of(SceneObject(mesh_key=1, T_cam_obj=at(0, 0, 0.5)), samples=2)
    lit = replace(lamps, environment=Environment(path=path, R_cam_env=np.eye(3)), ambient_rgb=(0.0, 0.0, 0.0))
    renders = [engine.render(scene).rgb_linear.tobytes() for scene in (lamps, lit, lamps, lit)]
    assert renders[:2] == renders[2:]
    fresh = make_engine("cycles", threads=1)
    fresh.load({1: ball()})
    assert [fresh.render(scene).rgb_linear.tobytes() for scene in (lit, lamps)] == renders[1::-1]
    fresh.close()
    engine.close()
    assert [len(x) for x in (bpy.data.worlds, bpy.data.images)] == before


@pytest.mark.parametrize("suffix", ["hdr", "exr"])
def test_a_panorama_that_is_cut_off_or_no_file_is_named(tmp_path, suffix, capfd):
    write_hdr(tmp_path / "good.hdr", 30, 20)
    file = tmp_path / f"bad.{suffix}"
    if suffix == "exr":
        pixels = np.random.default_rng(0).random((64, 128, 3), np.float32)
        with OpenEXR.File({"type": OpenEXR.scanlineimage}, {"RGB": OpenEXR.Channel(pixels)}) as made:
            made.write(str(file))
    else:
        noise = np.random.default_rng(0).random((64, 128, 3), np.float32)
        assert cv2.imwrite(str(file), noise)
    hdri.list_hdris(tmp_path)
    data = file.read_bytes()
    file.write_bytes(data[: len(data) * 2 // 3])
    with pytest.raises(ConfigError, match=rf"bad\.{suffix}: "):
        hdri.list_hdris(tmp_path)
    file.unlink()
    os.mkfifo(file)
    with pytest.raises(ConfigError, match=rf"bad\.{suffix}: "):
        hdri.list_hdris(tmp_path)
    printed = capfd.readouterr().err
    assert printed == "" or suffix == "exr"  # OpenEXR's own library prints a line of its own
