"""Result files: round trips, and one line with file and line number for everything that is wrong in them."""

import json

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from posecore import se3
from posecore.bop import (
    BopDataset,
    Estimate,
    ResultTable,
    estimate_table,
    read_result_table,
    read_results,
    read_sidecar,
    sidecar_path,
    write_results,
)
from posecore.bop.result_table import COLUMNS, parse_results
from posecore.bop.results import POINT, Extent, in_metres
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
    write_results(path, estimates, {"dataset": "things", "method": "initial"})
    back = read_results(path)
    assert [(e.scene_id, e.im_id, e.obj_id, e.score, e.time_s) for e in back] == [
        (e.scene_id, e.im_id, e.obj_id, e.score, e.time_s) for e in estimates
    ]
    assert [e.line for e in back] == [2, 3, 4, 5, 6]
    for before, after in zip(estimates, back, strict=True):
        assert np.abs(before.T_cam_obj - after.T_cam_obj).max() < 1e-9
    assert path.read_text().splitlines()[0] == HEADER
    assert read_sidecar(path) == {"dataset": "things", "method": "initial"}
    assert sidecar_path(path) == tmp_path / "r.csv.json"


def test_millimetres_in_the_file(tmp_path):
    path = tmp_path / "r.csv"
    write_results(path, [estimate(1, T_cam_obj=se3.make_T(np.eye(3), np.array([0.01, -0.02, 0.9])))])
    assert "10.0 -20.0 900.0" in path.read_text()
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
    with pytest.raises(ResultFileError, match=r"r.csv:2: the median length of t in the file is 0\.9.*in metres"):
        read_results(path)


def test_an_origin_at_the_camera_is_not_in_metres(tmp_path):
    path = tmp_path / "r.csv"
    path.write_text(f"{HEADER}\n1,2,3,0.5,1 0 0 0 1 0 0 0 1,0 0 0,-1\n")
    (pose,) = read_results(path)
    assert not pose.T_cam_obj[:3, 3].any()
    T = np.array([se3.make_T(np.eye(3), np.array([0.0, 0.0, 0.004]))])
    assert in_metres(T, [POINT])
    assert not in_metres(T, [Extent(np.array([0.0, 0.0, 0.6]), 0.2)])


def test_metres_are_suspected_of_an_object_with_its_origin_at_its_side():
    T = np.array([se3.make_T(np.eye(3), np.array([0.0, 0.0, 5e-4]))])
    assert in_metres(T, [Extent(np.array([0.0, 0.1, 0.05]), 0.2)])
    assert not in_metres(T, [Extent(np.array([0.0, 0.1, 0.1]), 0.2)])


@pytest.mark.parametrize("text", [HEADER, f"{HEADER}\n\n", f"\n {HEADER} \r\n"])
def test_a_header_alone_is_a_file_without_estimates(tmp_path, text):
    path = tmp_path / "r.csv"
    path.write_text(text)
    assert read_results(path) == []
    assert len(read_result_table(path)) == 0


@pytest.mark.parametrize("text", ["", "\n\n", "\ufeff", " \x1c\n"])
def test_an_empty_file_is_refused(tmp_path, text):
    path = tmp_path / "r.csv"
    path.write_text(text, encoding="utf-8")
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


@pytest.mark.slow
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


def columns_of(table):
    return {name: getattr(table, name) for name in ("scene_id", "im_id", "obj_id", "score", "T_cam_obj", "time_s")}


def lines_of(count):
    """Lines as methods write them: signs, exponents, many and few decimals."""
    rng = np.random.default_rng(5)
    lines = []
    for index in range(count):
        R = se3.random_rotation(rng).reshape(-1)
        t = [*rng.normal(0, 100, 2), 400 + 600 * rng.random()]
        formats = (".9f", ".17g", "+.12e", ".6g")
        spec = formats[index % 4]
        numbers = " ".join(format(value, spec) for value in R), " ".join(format(value, spec) for value in t)
        lines.append(f"{index % 7},{index},{index % 3 + 1},{rng.random()!r},{numbers[0]},{numbers[1]},{index % 2 - 1}")
    return lines


def test_lines_read_all_at_once_give_the_floats_of_python(tmp_path):
    """Twins: the fast reader and one line after the other agree to the last bit."""
    lines = lines_of(400)
    fast = parse_results("\n".join(lines).encode(), "r.csv")
    slow = parse_results("\n".join(line.replace(",", "\t,") for line in lines).encode(), "r.csv")
    for name, values in columns_of(fast).items():
        assert np.array_equal(values, getattr(slow, name)), name
    t_mm = [float(part) for part in lines[17].split(",")[5].split()]
    assert np.array_equal(fast.T_cam_obj[17, :3, 3], np.array(t_mm) * 1e-3)
    assert fast.line.tolist() == list(range(1, 401))


def test_lines_keep_their_numbers_across_chunks(monkeypatch):
    monkeypatch.setattr("posecore.bop.result_table.CHUNK_BYTES", 1000)
    lines = [HEADER, *lines_of(60), "", *lines_of(3)]
    table = parse_results("\r\n".join(lines).encode(), "r.csv")
    assert table.line.tolist() == [*range(2, 62), 63, 64, 65]
    lines[40] = lines[40].replace(",", ";", 1)
    with pytest.raises(ResultFileError, match=r"^r.csv:41: found 6 fields"):
        parse_results("\n".join(lines).encode(), "r.csv")


def test_a_line_longer_than_a_chunk_is_read(monkeypatch):
    monkeypatch.setattr("posecore.bop.result_table.CHUNK_BYTES", 50)
    assert len(parse_results(f"{GOOD}\n{' ' * 500}{GOOD}\n{GOOD}".encode(), "r.csv")) == 3


@pytest.mark.parametrize("order", [(6, 5, 4, 3, 2, 1, 0), (3, 0, 4, 1, 5, 2, 6)])
@pytest.mark.parametrize("space", ["", " ", "\t"])
def test_a_header_may_name_the_columns_in_another_order(order, space):
    lines = lines_of(20)
    header = f"{space},{space}".join(COLUMNS[i] for i in order)
    moved = [",".join(line.split(",")[i] for i in order) for line in lines]
    straight = parse_results("\n".join(lines).encode(), "r.csv")
    table = parse_results("\n".join([space + header, *moved]).encode(), "r.csv")
    for name, values in columns_of(straight).items():
        assert np.array_equal(values, getattr(table, name)), name


@pytest.mark.parametrize(
    ("header", "message"),
    [
        ("scene_id,im_id,obj_id,score,R,t", "missing time, unknown none"),
        ("scene_id,im_id,obj_id,score,R,t,runtime", "missing time, unknown runtime"),
        ("scene_id,im_id,obj_id,obj_id,R,t,time", "missing score, unknown none, twice obj_id"),
    ],
)
def test_another_header_is_refused_by_name(header, message):
    with pytest.raises(ResultFileError, match=rf"^r.csv:1: the header is not .*: {message}"):
        parse_results(f"{header}\n{GOOD}\n".encode(), "r.csv")


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("1,2,3,0.5,1 0 0 0 1 0 0 0 1,10 20 900,1_0", "time is '1_0'"),
        ("1,2,3,0.5,1 0 0 0 1 0 0 0 1,1\u0661 20 900,-1", "t is '1\u0661 20 900'"),
        ("1,2,3,0.5,1 0 0 0 1 0 0 0 1,10 20 9e99,-1", "t holds 9e+99 mm"),
        ("1,2,3,0.5,1 0 0 0 1 0 0 0 1,10 20 9e999,-1", "t holds NaN or infinity"),
        ("1,2,3,0.5,1 0 0 0 1 0 0 0 1,10 20-900,-1", "t is '10 20-900'"),
        ("1e0,2,3,0.5,1 0 0 0 1 0 0 0 1,10 20 900,-1", "scene_id is '1e0'"),
        ("+1,2,3,0.5,1 0 0 0 1 0 0 0 1,10 20 900,-1", "scene_id is '+1'"),
        ("1,2,9223372036854775808,0.5,1 0 0 0 1 0 0 0 1,10 20 900,-1", "a whole number from 0 to 9223372036854775807"),
        ("1,2,3,0.5 0.5,1 0 0 0 1 0 0 0 1,10 20 900,-1", "score has 2 numbers"),
        ("1,2,3,,1 0 0 0 1 0 0 0 1,10 20 900,-1", "score has 0 numbers"),
        ("1,2,3,0.5,1e200 0 0 0 1e200 0 0 0 1e200,10 20 900,-1", "R is "),
    ],
)
def test_what_a_lenient_reader_would_take_is_refused(line, message):
    """Python reads underscores and other alphabets' digits, a fast reader two numbers in `20-900`."""
    with pytest.raises(ResultFileError) as caught:
        parse_results(f"{GOOD}\n{line}\n".encode(), "r.csv")
    assert str(caught.value).startswith("r.csv:2: ")
    assert message in str(caught.value)


def test_large_ids_stay_exact():
    """Beyond 2^53 a float would round them."""
    line = GOOD.replace("1,2,3", "1,900719925474099312,3", 1)
    assert parse_results(line.encode(), "r.csv").im_id.tolist() == [900719925474099312]


def test_all_faults_are_told_and_the_good_lines_kept():
    faults = []
    text = "\n".join([GOOD, "1,2", GOOD.replace("0.5", "nan"), GOOD, GOOD.replace("1 0 0 0 1", "2 0 0 0 1")])
    table = parse_results(text.encode(), "r.csv", faults.append)
    assert table.line.tolist() == [1, 4]
    assert [(fault.line, fault.field, fault.kind) for fault in faults] == [
        (2, "line", "fields"),
        (3, "score", "not finite"),
        (5, "R", "rotation"),
    ]


def test_a_table_is_cut_and_joined():
    table = estimate_table([estimate(seed) for seed in range(4)])
    both = ResultTable.concat([table.take(np.array([3])), table.take(table.im_id < 2)])
    assert both.im_id.tolist() == [3, 0, 1]
    assert np.array_equal(both.T_cam_obj[0], estimate(3).T_cam_obj)
    assert len(ResultTable.concat([])) == 0


def test_unknown_ids_are_refused_with_the_first_line(shared_data, tmp_path):
    dataset = BopDataset(shared_data / "lmo")
    lines = (shared_data / "lmo/init_ssd6d-like_lmo-test.csv").read_text().splitlines()
    for number, (change, message) in enumerate(
        [(("2,3,", "9,3,"), "scene 9 is not in"), (("2,3,", "2,4,"), "image 4 has no ground truth in")]
    ):
        path = tmp_path / f"{number}.csv"
        path.write_text("\n".join([*lines[:5], lines[5].replace(*change, 1), *lines[6:]]))
        with pytest.raises(ResultFileError, match=rf"{number}.csv:6: {message}"):
            read_result_table(path, dataset)
    path.write_text("\n".join([*lines[:300], lines[300].replace(",1.0,", "3,1.0,", 1)]))
    with pytest.raises(ResultFileError, match=r":301: object \d+ is unknown, lmo has 1, 5, 6"):
        read_result_table(path, dataset)


@pytest.mark.parametrize("im_id", [1714129813249, 171412981324912345, 1714129813249123450, 2**63 - 1])
def test_ids_of_64_bits_such_as_ros_stamps_are_read_as_written(tmp_path, im_id):
    T = np.eye(4)
    T[2, 3] = 1
    write_results(tmp_path / "r.csv", [Estimate(scene_id=im_id, im_id=im_id, obj_id=1, T_cam_obj=T)])
    (read,) = read_results(tmp_path / "r.csv")
    assert (read.scene_id, read.im_id) == (im_id, im_id)
