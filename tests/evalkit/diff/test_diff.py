"""`evalkit diff`: deltas known beforehand, pairing, rules and exit codes, with a dataset and with tables of errors."""

import json
import re
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from click.testing import CliRunner
from error_tables import errors_table
from evalkit.cli import main
from evalkit.diff import COUNTS, MEASURES, Side, Sides, differences, judge, open_sides, parse_rule
from evalkit.diff.deltas import paired_rows
from evalkit.diff.rules import OPERATORS, STATISTICS
from evalkit.diff.sides import read_errors
from evalkit.report.job import estimates_csv
from posecore import se3
from posecore.bop import write_results
from posecore.errors import ConfigError

NAN = float("nan")


def run(*arguments):
    return CliRunner().invoke(main, [str(argument) for argument in arguments], catch_exceptions=False)


def sides(a, b, tmp_path):
    return Sides(
        a=Side(name="old", path=tmp_path / "a.csv", sha256="", table=a),
        b=Side(name="new", path=tmp_path / "b.csv", sha256="", table=b),
        evaluator=None,
    )


def write_errors(path, **tables):
    """A table of errors as `evalkit report` writes it."""
    parts = []
    for name, table in tables.items():
        part = table.copy()
        part[["found", "symmetric"]] = part[["found", "symmetric"]].astype("int64")
        part.insert(0, "results", name)
        parts.append(part)
    pd.concat(parts).to_csv(path, index=False, float_format="%.9g")
    return path


def two_files(tmp_path):
    """Ten poses: VSS falls by 0.02 everywhere, ADD rises by 1 mm; of two objects."""
    ten = {"obj_id": [1, 5] * 5, "re_sym_rad": np.deg2rad(3.0)}
    a = errors_table(10, vss=0.9, add_m=0.004, **ten)
    b = errors_table(10, vss=0.88, add_m=0.005, **ten)
    return write_errors(tmp_path / "a.csv", old=a), write_errors(tmp_path / "b.csv", new=b)


def test_known_deltas(tmp_path):
    rng = np.random.default_rng(0)
    a = errors_table(50, vss=rng.uniform(0.5, 0.9, 50), add_m=rng.uniform(0.001, 0.02, 50))
    b = a.copy()
    b["vss"] += 0.05
    b["add_m"] -= 0.0005
    b["re_sym_rad"] = np.deg2rad(np.where(np.arange(50) < 10, 2.0, 0.5))
    found = differences(sides(a, b, tmp_path))
    assert found.changes["vss"].mean_delta == pytest.approx(0.05)
    assert found.changes["vss"].mean_interval == pytest.approx((0.05, 0.05))
    assert found.changes["add"].median_delta == pytest.approx(-0.5)
    turned = found.changes["re_sym"]
    assert (turned.mean_delta, turned.median_delta) == pytest.approx((0.8, 0.5))
    assert turned.mean_interval[0] < 0.8 < turned.mean_interval[1]
    assert found.changes["vss"].mean_b - found.changes["vss"].mean_a == pytest.approx(0.05)
    assert found.changes["adi"].mean_delta == 0.0
    assert found.resampled == "50 images"
    np.testing.assert_allclose(found.pairs.add_delta, -0.5)


def test_the_interval_of_paired_deltas_is_narrower_than_that_of_either_file(tmp_path):
    rng = np.random.default_rng(1)
    a = errors_table(60, vss=rng.uniform(0.2, 0.9, 60))
    b = a.copy()
    b["vss"] += rng.normal(0.02, 0.005, 60)
    low, high = differences(sides(a, b, tmp_path)).changes["vss"].mean_interval
    assert 0.015 < low < 0.02 < high < 0.025


def test_identical_files_differ_by_nothing(tmp_path):
    table = errors_table(6, found=[True] * 5 + [False], mspd_px=[1, 2, np.inf, 3, 4, 5], vss=0.7)
    found = differences(sides(table, table.copy(), tmp_path))
    for name, change in found.changes.items():
        assert change.mean_delta == change.median_delta == 0.0, name
        assert change.mean_interval == (0.0, 0.0), name
    assert set(found.counts.values()) == {0}
    assert not judge([parse_rule("vss < 0"), parse_rule("newly_failed > 0"), parse_rule("lower(add) < 0")], found)[
        0
    ].fired


def test_missing_estimates_are_failures_and_have_no_error_delta(tmp_path):
    a = errors_table(4, vss=0.8)
    b = errors_table(4, vss=0.8, found=[True, True, True, False])
    found = differences(sides(a, b, tmp_path))
    assert found.changes["vss"].mean_delta == pytest.approx(-0.2)
    assert found.changes["recall"].mean_delta == pytest.approx(-0.25)
    assert found.changes["add"].poses == 3
    assert found.changes["vss"].poses == 4
    assert found.lost.im_id.tolist() == [3]
    assert found.newly_failed.im_id.tolist() == [3]
    assert found.counts == {"newly_failed": 1, "newly_solved": 0, "lost": 1, "gained": 0, "unpaired": 0}
    back = differences(sides(b, a, tmp_path))
    assert (back.counts["newly_solved"], back.counts["gained"]) == (1, 1)


def test_newly_failed_come_with_the_largest_changes_first(tmp_path):
    a = errors_table(5, add_m=[0.001, 0.009, 0.002, 0.05, 0.001])
    b = errors_table(5, add_m=[0.011, 0.0101, 0.09, 0.06, 0.001])
    found = differences(sides(a, b, tmp_path))
    assert found.newly_failed.im_id.tolist() == [2, 0, 1]
    assert found.newly_solved.empty
    assert found.pairs.status.tolist()[3:] == ["both failed", "both solved"]
    assert differences(sides(a, b, tmp_path), limit_diameters=0.5).newly_failed.im_id.tolist() == [2]


def test_poses_are_paired_by_instance_and_start_whatever_their_order(tmp_path):
    initial_poses = {
        "initial_angle_deg": [5.0, 10.0, 5.0, NAN, NAN],
        "initial_translation_diameter": [0.0, 0.0, 0.0, NAN, NAN],
    }
    a = errors_table(5, im_id=[0, 0, 1, 1, 1], vss=[0.1, 0.2, 0.3, 0.4, 0.5], **initial_poses)
    b = a.iloc[[2, 0, 3, 1, 4]].reset_index(drop=True)
    rows_a, rows_b = paired_rows(a, b)
    np.testing.assert_array_equal(a.vss.to_numpy()[rows_a], b.vss.to_numpy()[rows_b])
    assert len(rows_a) == 5


def test_poses_of_one_file_only_are_left_out_and_said(tmp_path):
    a, b = errors_table(4), errors_table(3, im_id=[2, 3, 9])
    found = differences(sides(a, b, tmp_path))
    assert len(found.pairs) == 2
    assert found.only_a.im_id.tolist() == [0, 1]
    assert found.only_b.im_id.tolist() == [9]
    assert found.counts["unpaired"] == 3
    with pytest.raises(ConfigError, match="no expected pose is in both"):
        differences(sides(a, errors_table(2, obj_id=7), tmp_path))


# Rules


def test_a_rule_is_read():
    rule = parse_rule(" lower( re_sym )>=-1.5e-1 ")
    assert (rule.statistic, rule.name, rule.operator, rule.limit) == ("lower", "re_sym", ">=", -0.15)
    assert parse_rule("vss<-.01").statistic == "mean"
    assert parse_rule("newly_failed > 3").name == "newly_failed"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("vss", "expected NAME OPERATOR NUMBER"),
        ("vss = 1", "operators are <=, >=, <, >"),
        ("vss < lots", "expected NAME OPERATOR NUMBER"),
        ("speed < 1", "'speed' is unknown; names are vss, recall"),
        ("worst(vss) < 1", "'worst' is unknown.*statistics are mean, median, lower, upper"),
        ("upper(lost) > 1", "lost is a number of poses"),
        ("vss < -0.01 and add > 1", "expected NAME"),
    ],
)
def test_a_rule_that_cannot_be_read_lists_what_there_is(text, message):
    with pytest.raises(ConfigError, match=message):
        parse_rule(text)


@pytest.mark.parametrize(
    ("rule", "fires"),
    [
        ("vss < -0.01", True),
        ("vss < -0.03", False),
        ("vss >= -0.021", True),
        ("add > 0.9", True),
        ("add <= 0.9", False),
        ("median(add) > 1.1", False),
        ("upper(vss) < 0", True),
        ("lower(vss) > 0", False),
        ("recall < 0", False),
        ("lost > 0", False),
        ("newly_failed >= 0", True),
    ],
)
def test_rules_decide_the_exit_code(tmp_path, rule, fires):
    a, b = two_files(tmp_path)
    result = run("diff", a, b, "--fail-if", rule)
    assert result.exit_code == (1 if fires else 0)
    said = result.stderr if fires else result.stdout
    assert f"{'FAILED' if fires else 'passed'}: '{rule}'" in said


def test_every_rule_is_judged_and_those_that_fired_are_named(tmp_path):
    a, b = two_files(tmp_path)
    result = run("diff", a, b, "--fail-if", "vss < -0.01", "--fail-if", "te > 1", "--fail-if", "add > 0.5")
    assert result.exit_code == 1
    assert "FAILED: 'vss < -0.01' is so: -0.02" in result.stderr
    assert "FAILED: 'add > 0.5' is so: 1" in result.stderr
    assert "passed: 'te > 1' is not so: 0" in result.stdout


def test_a_rule_without_a_value_fails(tmp_path):
    nothing = errors_table(3, found=False)
    found = differences(sides(nothing, nothing.copy(), tmp_path))
    (verdict,) = judge([parse_rule("add > 5")], found)
    assert verdict.fired
    assert "cannot be judged" in verdict.words
    alone = errors_table(1)
    (verdict,) = judge([parse_rule("lower(vss) < -1")], differences(sides(alone, alone.copy(), tmp_path)))
    assert verdict.fired


def test_a_bad_rule_is_a_usage_error_before_anything_is_read(tmp_path):
    result = run("diff", tmp_path / "none.csv", tmp_path / "none.csv", "--fail-if", "vs < 1")
    assert result.exit_code == 2
    assert "'vs' is unknown; names are vss, recall" in result.stderr


def test_the_help_names_every_rule_part():
    shown = run("diff", "--help").output
    for name in (*MEASURES, *COUNTS, *OPERATORS, *STATISTICS):
        assert re.search(rf"(?<!\w){re.escape(name)}(?!\w)", shown), name


# Tables of errors


def test_the_terminal_shows_both_files_and_the_changes(tmp_path):
    a, b = two_files(tmp_path)
    result = run("diff", a, b, "--list", 1)
    assert result.exit_code == 0
    assert "A  old: 10 expected poses, 0 missing" in result.stdout
    vss = next(line for line in result.stdout.splitlines() if line.startswith("vss"))
    both = "0.9000 0.8800 -0.0200 [-0.0200, -0.0200]"
    assert " ".join(vss.split()) == f"vss 10 {both} {both}"
    assert "by resampling 10 images" in result.stdout
    assert "Newly failed (ADD(-S) of 0.1 diameter or more): 0" in result.stdout


def test_a_report_table_of_several_files_needs_their_names(tmp_path):
    a = write_errors(tmp_path / "estimates.csv", start=errors_table(3, vss=0.5), fine=errors_table(3, vss=0.75))
    result = run("diff", a, a)
    assert result.exit_code == 2
    assert "holds start, fine; name one with --result-a and --result-b" in result.stderr
    result = run("diff", a, a, "--result-a", "start", "--result-b", "fine", "--json", tmp_path / "d.json")
    assert result.exit_code == 0
    content = json.loads((tmp_path / "d.json").read_text())
    assert (content["a"]["name"], content["b"]["name"]) == ("start", "fine")
    assert content["measures"]["vss"]["mean_delta"] == pytest.approx(0.25)
    result = run("diff", a, a, "--result-a", "start", "--result-b", "coarse")
    assert result.exit_code == 2
    assert "no result file 'coarse'; it holds start, fine" in result.stderr


@pytest.mark.parametrize("name", ["perfect", "=SUM(1)"])
def test_the_table_of_a_report_reads_back_as_it_was(dataset, perfect, tmp_path, name):
    path = tmp_path / f"{name}.csv"
    write_results(path, perfect[:-1])
    with open_sides((path, path), dataset=dataset.root) as both:
        written = tmp_path / "estimates.csv"
        written.write_text(estimates_csv([both.a.scored]))
        table = both.a.table
    with open_sides((written, written)) as both:
        assert both.evaluator is None
        assert both.a.name == f"{name} (A)"
        assert written.read_text().splitlines()[1].startswith(f"'{name}," if name.startswith("=") else f"{name},")
        read = both.a.table[table.columns]
        pd.testing.assert_frame_equal(read, table.reset_index(drop=True), rtol=1e-8, atol=1e-12)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda text: text.replace("add_m", "add_cm"), "e.csv:1: no column add_m; write the table again"),
        (lambda text: text.replace(",0.9,", ",high,", 1), "e.csv:2: vss is 'high', expected a number"),
        (lambda text: text + "old,1\n", "e.csv:4: found 2 fields, expected"),
        (lambda text: text.replace("old,1,", "old,1.5,", 1), "e.csv:2: scene_id is '1.5', expected a whole number"),
        (lambda text: text.replace("old,1,", "old,,", 1), "e.csv:2: scene_id is '', expected a whole number"),
    ],
)
def test_a_broken_table_is_one_line(tmp_path, change, message):
    good = write_errors(tmp_path / "good.csv", old=errors_table(2, vss=0.9))
    bad = tmp_path / "e.csv"
    bad.write_text(change(good.read_text()))
    result = run("diff", good, bad)
    assert result.exit_code == 1
    assert message in result.stderr
    assert result.stderr.count("\n") == 1


def test_columns_that_a_later_report_adds_do_no_harm(tmp_path):
    table = errors_table(2)
    table["cause"], table["vsd_0.05"] = ["large", ""], 0.5
    path = write_errors(tmp_path / "e.csv", old=table)
    assert run("diff", path, path).exit_code == 0


def test_missing_files_are_one_line(tmp_path):
    good = write_errors(tmp_path / "good.csv", old=errors_table(2))
    result = run("diff", good, tmp_path / "none.csv")
    assert result.exit_code == 1
    assert "none.csv: cannot be read" in result.stderr


def test_the_csv_has_a_line_for_each_pair_with_units(tmp_path):
    a, b = two_files(tmp_path)
    assert run("diff", a, b, "--csv", tmp_path / "d.csv").exit_code == 0
    table = pd.read_csv(tmp_path / "d.csv")
    assert len(table) == 10
    np.testing.assert_allclose(table.add_delta_mm, 1.0)
    np.testing.assert_allclose(table.vss_delta, -0.02)
    assert {"scene_id", "line_a", "found_b", "status", "re_sym_b_deg", "mspd_a_px"} <= set(table.columns)
    assert "row_a" not in table


# Result files


@pytest.fixture
def results(dataset, perfect, tmp_path):
    """Ground truth, and the same with one pose 3 cm too far, one flipped and one missing; the first has its sidecar."""
    worse = list(perfect)
    worse[0] = replace(worse[0], T_cam_obj=se3.apply_update(worse[0].T_cam_obj, np.eye(3), np.array([0, 0, 0.03])))
    half_turn = se3.rotation_from_rotvec(np.array([np.pi, 0.0, 0.0]))
    worse[2] = replace(worse[2], T_cam_obj=se3.apply_update(worse[2].T_cam_obj, half_turn, np.zeros(3)))
    write_results(tmp_path / "good.csv", perfect, {"dataset": str(dataset.root), "method": "truth"})
    write_results(tmp_path / "worse.csv", worse[:-1])
    return tmp_path / "good.csv", tmp_path / "worse.csv"


def test_result_files_are_evaluated_and_shown(results, tmp_path):
    page, summary = tmp_path / "out/diff.html", tmp_path / "diff.json"
    result = run("diff", *results, "--html", page, "--json", summary, "--fail-if", "newly_failed > 2")
    assert result.exit_code == 1
    assert "'newly_failed > 2' is so: 3" in result.stderr
    content = json.loads(summary.read_text())
    assert content["newly_failed"][0]["cause_b"] == "missed"
    assert {row["cause_b"] for row in content["newly_failed"]} == {"missed", "z only", "flip"}
    assert len(content["found_in_a_only"]) == 1
    assert content["measures"]["recall"]["mean_delta"] == pytest.approx(-0.5)
    assert content["measures"]["tz"]["mean_delta"] == pytest.approx(30.0 / 5)
    assert content["rules"] == [{"rule": "newly_failed > 2", "value": 3.0, "fired": True}]
    assert "evalkit" in content and "Infinity" not in summary.read_text()
    html = page.read_text()
    assert html.count("data:image/jpeg;base64,") == 6  # three poses, each as both files have it
    assert "Newly failed" in html and "Newly solved" not in html
    assert not re.search(r'(src|href)="(?!data:|#)', html)


def test_the_order_of_the_files_is_kept_also_where_the_second_holds_start_poses(dataset, perfect, tmp_path):
    write_results(tmp_path / "refined.csv", perfect, {"dataset": str(dataset.root)})
    write_results(tmp_path / "start.csv", perfect[:-1], {"dataset": str(dataset.root), "method": "initial"})
    with open_sides((tmp_path / "refined.csv", tmp_path / "start.csv")) as both:
        assert (both.a.name, both.b.name) == ("refined", "start")


def test_one_file_against_itself_is_all_zero(results):
    result = run("diff", results[1], results[1], "--dataset", results[0].parent / "none")
    assert result.exit_code == 1
    result = run("diff", results[0], results[0], "--fail-if", "vss < 0", "--fail-if", "newly_failed > 0")
    assert result.exit_code == 0, result.output
    assert "good (A)" in result.stdout
    assert "good (B)" in result.stdout


def test_error_tables_of_earlier_versions_are_read(tmp_path):
    table = errors_table(3, initial_angle_deg=[5.0, 10.0, 15.0], initial_translation_diameter=0.0)
    path = write_errors(tmp_path / "estimates.csv", refined=table)
    head, rest = path.read_text().split("\n", 1)
    old = head.replace("initial_angle_deg", "start_angle_deg").replace("initial_trans", "start_trans")
    assert old != head
    path.write_text(f"{old}\n{rest}")
    read = read_errors(path).table
    assert read.initial_angle_deg.tolist() == [5.0, 10.0, 15.0]
    assert read.initial_translation_diameter.tolist() == [0.0] * 3
