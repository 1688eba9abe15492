"""Result files: round trips, and one line with file and line number for everything that is wrong in them."""

import json

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from posecore import se3
from posecore.bop import Estimate, read_results, read_sidecar, sidecar_path, write_results
from posecore.errors import DatasetError, ResultFileError

HEADER = "scene_id,im_id,obj_id,score,R,t,time"
GOOD = "1,2,3,0.5,1 0 0 0 1 0 0 0 1,10 20 900,-1"


def estimate(seed, **changes):
    rng = np.random.default_rng(seed)
    T = se3.make_T(se3.random_rotation(rng), np.array([*rng.normal(size=2), 1.0 + rng.random()]))
    fields = {"scene_id": 1, "im_id": seed, "obj_id": 3, "score": 0.25, "T_cam_obj": T, "time_s": 0.125}
    return Estimate(**{**fields, **changes})


def test_round_trip_keeps_nine_decimals(tmp_path):
    path = tmp_path / "r.csv"
    estimates = [estimate(seed) for seed in range(5)]
    write_results(path, estimates, {"dataset": "things", "method": "start"})
    back = read_results(path)
    assert [(e.scene_id, e.im_id, e.obj_id, e.score, e.time_s) for e in back] == [
        (e.scene_id, e.im_id, e.obj_id, e.score, e.time_s) for e in estimates
    ]
    assert [e.line for e in back] == [2, 3, 4, 5, 6]
    for before, after in zip(estimates, back, strict=True):
        assert np.abs(before.T_cam_obj - after.T_cam_obj).max() < 1e-9
    assert path.read_text().splitlines()[0] == HEADER
    assert read_sidecar(path) == {"dataset": "things", "method": "start"}
    assert sidecar_path(path) == tmp_path / "r.csv.json"


def test_millimetres_in_the_file(tmp_path):
    path = tmp_path / "r.csv"
    write_results(path, [estimate(1, T_cam_obj=se3.make_T(np.eye(3), np.array([0.01, -0.02, 0.9])))])
    assert "10.000000000 -20.000000000 900.000000000" in path.read_text()
    assert not sidecar_path(path).exists()
    assert read_sidecar(path) is None


@pytest.mark.parametrize("text", [f"{HEADER}\n{GOOD}\n", GOOD, f"\ufeff{HEADER}\r\n{GOOD}\r\n\r\n"])
def test_header_line_ends_and_byte_order_mark_are_optional(tmp_path, text):
    path = tmp_path / "r.csv"
    path.write_bytes(text.encode())
    (only,) = read_results(path)
    assert np.allclose(only.T_cam_obj[:3, 3], [0.01, 0.02, 0.9])


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("1,2,3,0.5,1 0 0 0 1 0 0 0 1,10 20 900", "found 6 fields"),
        ("1,2,3,0.5,1 0 0 0 1 0 0 0 1,10 nan 900,-1", "t holds NaN"),
        ("1,2,3,0.5,1 0 0 0 inf 0 0 0 1,10 0 900,-1", "R holds NaN or infinity"),
        ("1,2,3,nan,1 0 0 0 1 0 0 0 1,10 0 900,-1", "score holds NaN"),
        ("1,2,3,0.5,2 0 0 0 2 0 0 0 2,10 0 900,-1", "R is scaled by 2,"),
        ("1,2,3,0.5,-1 0 0 0 1 0 0 0 1,10 0 900,-1", "R is mirrored"),
        ("1,2,3,0.5,1 0.5 0 0 1 0 0 0 1,10 0 900,-1", "R is not orthonormal"),
        ("1,2,3,0.5,0 0 0 0 0 0 0 0 0,10 0 900,-1", "R is not orthonormal"),
        ("1,2,3,0.5,1 0 0 0 1 0 0 0,10 0 900,-1", "R has 8 numbers, expected 9"),
        ("1,2,3,0.5,1 0 0 0 1 0 0 0 1,10 0,-1", "t has 2 numbers"),
        ("1,2.5,3,0.5,1 0 0 0 1 0 0 0 1,10 0 900,-1", "im_id is '2.5'"),
        ("1,2,-3,0.5,1 0 0 0 1 0 0 0 1,10 0 900,-1", "obj_id is '-3'"),
        ("1,2,3,high,1 0 0 0 1 0 0 0 1,10 0 900,-1", "score is 'high'"),
    ],
)
def test_broken_lines_are_named(tmp_path, line, message):
    path = tmp_path / "r.csv"
    path.write_text(f"{HEADER}\n{GOOD}\n{line}\n")
    with pytest.raises(ResultFileError) as caught:
        read_results(path)
    assert str(caught.value).startswith(f"{path}:3: ")
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_metres_are_suspected(tmp_path):
    path = tmp_path / "r.csv"
    path.write_text(f"{HEADER}\n1,2,3,0.5,1 0 0 0 1 0 0 0 1,0.01 0.02 0.9,-1\n")
    with pytest.raises(ResultFileError, match=r"r.csv:2: the median t_z of the file is 0.9, which looks like metres"):
        read_results(path)


@pytest.mark.parametrize("text", ["", HEADER, f"{HEADER}\n\n"])
def test_no_results(tmp_path, text):
    path = tmp_path / "r.csv"
    path.write_text(text)
    with pytest.raises(ResultFileError, match="no estimates"):
        read_results(path)
    with pytest.raises(ResultFileError, match="cannot be read"):
        read_results(tmp_path / "other.csv")


def test_broken_sidecar_names_line_and_column(tmp_path):
    sidecar_path(tmp_path / "r.csv").write_text('{"dataset": }')
    with pytest.raises(DatasetError, match=r"r.csv.json:1:13: invalid JSON"):
        read_sidecar(tmp_path / "r.csv")


def test_start_poses_of_real_data_read(shared_data):
    assert len(read_results(shared_data / "lmo/init_ssd6d-like_lmo-test.csv")) == 349


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None, max_examples=200)
@given(st.binary(max_size=200))
def test_any_bytes_are_read_or_refused_cleanly(tmp_path, data):
    path = tmp_path / "r.csv"
    path.write_bytes(data)
    with pytest.raises(ResultFileError):
        read_results(path)


number = st.one_of(st.floats(allow_nan=True), st.integers(-5, 5000), st.sampled_from(["", "x", "1e999", "0x1", "½"]))


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None, max_examples=200)
@given(
    st.lists(number, min_size=3, max_size=3),
    st.lists(number, min_size=8, max_size=10),
    st.lists(number, min_size=2, max_size=4),
    number,
)
def test_lines_of_any_numbers_are_read_or_refused_cleanly(tmp_path, ids, R, t, time):
    path = tmp_path / "r.csv"
    fields = [*map(str, ids), "1", " ".join(map(str, R)), " ".join(map(str, t)), str(time)]
    path.write_text(f"{GOOD}\n{','.join(fields)}\n", encoding="utf-8")
    try:
        estimates, refusal = read_results(path), f"{path}:2: "
    except ResultFileError as error:
        estimates, refusal = [], str(error)
    assert refusal.startswith(f"{path}:2: ")
    assert all(np.isfinite(e.T_cam_obj).all() and se3.is_rotation(e.T_cam_obj[:3, :3], 2e-2) for e in estimates)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None, max_examples=50)
@given(st.integers(0, 2**31), st.floats(-1e6, 1e6), st.floats(-1, 1e4))
def test_any_estimate_survives_a_round_trip(tmp_path, seed, score, time_s):
    path = tmp_path / "r.csv"
    before = estimate(seed, score=score, time_s=time_s, im_id=seed)
    write_results(path, [before], json.loads("{}"))
    (after,) = read_results(path)
    assert np.abs(before.T_cam_obj - after.T_cam_obj).max() < 1e-9
    assert after.score == pytest.approx(score, rel=1e-8)
