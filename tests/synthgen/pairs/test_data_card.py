import json
import platform

import numpy as np
import pytest
from posecore.mesh import Mesh
from synthgen.config import load_config
from synthgen.inputs.assets import Assets
from synthgen.pairs import data_card


def test_the_card_tells_everything_but_time_and_place(config_of, tug):
    card = data_card.rendered_card(config_of(), 10, {1: tug}, Assets())
    text = json.dumps(card)
    assert platform.node() not in text
    assert str(tug.path) not in text
    assert card["objects"]["1"]["sha256"] == tug.sha256
    assert card["config"]["occluders"]["library"] == 8
    assert card["versions"]["posecore"]
    assert "bpy" not in card["versions"]
    assert "bpy" in data_card.rendered_card(config_of("engine=cycles"), 10, {1: tug}, Assets())["versions"]


def test_photographs_are_in_the_card_by_content(config_of, tug, tmp_path):
    (tmp_path / "a.jpg").write_bytes(b"1")
    one = data_card.rendered_card(config_of(), 10, {1: tug}, Assets(photos=(str(tmp_path / "a.jpg"),)))["backgrounds"]
    (tmp_path / "a.jpg").write_bytes(b"2")
    two = data_card.rendered_card(config_of(), 10, {1: tug}, Assets(photos=(str(tmp_path / "a.jpg"),)))["backgrounds"]
    assert one["photos"] == two["photos"] == 1
    assert one["sha256"] != two["sha256"]


@pytest.mark.parametrize("scale", [0.25, 3.0])  # 3 cm and 36 cm
def test_any_size_of_object_fits_the_defaults(config_of, tug, scale):
    mesh = Mesh(vertices_m=tug.vertices_m * scale, faces=tug.faces, normals=tug.normals, vertex_rgb=tug.vertex_rgb)
    card = data_card.rendered_card(config_of(), 1, {1: mesh}, Assets())
    plain = data_card.rendered_card(config_of(), 1, {1: tug}, Assets())
    side = [c["objects"]["1"]["window_side_px"] for c in (card, plain)]
    assert side[0] == pytest.approx(side[1])


@pytest.mark.parametrize(
    ("diameter_m", "step_m"), [(0.002, 6.25e-6), (0.03, 1e-4), (0.12, 1e-4), (2.0, 8e-4), (10.0, 3.2e-3)]
)
def test_depth_steps_follow_the_object(diameter_m, step_m):
    """By default an object stands up to 10 diameters away, with props up to 4 diameters behind it.

    16 bits hold the largest depth, and the smallest object is 200 steps wide.
    """
    half = diameter_m / 2
    mesh = Mesh(
        vertices_m=np.array([[-half, 0, 0], [half, 0, 0], [0, half / 2, 0], [0, 0, half / 2]]),
        faces=np.array([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]], np.int32),
        normals=np.tile(np.array([0, 0, 1], np.float32), (4, 1)),
    )
    card = data_card.rendered_card(load_config("default"), 8, {1: mesh}, Assets())
    assert card["depth_step_m"] == pytest.approx(step_m)
    assert card["depth_step_m"] * 65535 > 14 * diameter_m
    assert card["depth_step_m"] * 200 <= diameter_m
