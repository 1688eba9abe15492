import os
import re

import pytest
from click.testing import CliRunner
from synthgen.cli import main, options
from synthgen.cli.options import resumable


def invoke(*arguments):
    return CliRunner().invoke(main, [str(a) for a in arguments])


def error_line(result):
    assert "Traceback" not in result.output
    lines = [line for line in result.stderr.splitlines() if line.startswith("Error: ")]
    assert len(lines) == 1, result.output
    return lines[0]


@pytest.mark.parametrize("name", sorted(main.commands))
def test_every_command_has_an_example_and_every_option_help(name):
    command = main.commands[name]
    assert f"synthgen {name}" in (command.help or "")
    for parameter in command.params:
        assert parameter.param_type_name == "argument" or parameter.help, f"{name} {parameter.name}"
    page = invoke(name, "--help")
    assert page.exit_code == 0
    assert any(line.startswith(f"  synthgen {name} ") for line in page.output.splitlines()), "examples are re-wrapped"


def test_options_of_the_examples_exist():
    for name, command in main.commands.items():
        known = {option for p in command.params for option in p.opts}
        assert set(re.findall(r"--[a-z-]+", command.help or "")) <= known, name


def test_wrong_usage_ends_with_2(tug_ply, tmp_path):
    out = tmp_path / "out"
    for arguments in (
        ["render", "--object", tug_ply, "--n", "0", "--out", out],
        ["render", "--object", tug_ply, "--out", out],
        ["render", "--object", tug_ply, "--n", "4", "--out", out, "--engine", "povray"],
        ["render", "--object", tug_ply, "--n", "4", "--out", out, "--preset", "fast"],
        ["render", "--object", tug_ply, "--n", "4", "--out", out, "--set", "windw.padding=1"],
        ["render", "--object", tug_ply, "--n", "4", "--out", out, "--backgrounds", tmp_path / "none"],
        ["bop", "--object", tug_ply, "--frames", "0", "--out", out],
        ["preview", out, "--out", tmp_path / "sheet.gif"],
    ):
        result = invoke(*arguments)
        assert result.exit_code == 2, (arguments, result.output)
        assert "Traceback" not in result.output
    assert not out.exists()


def test_a_missing_mesh_is_one_line(tmp_path):
    result = invoke("render", "--object", tmp_path / "none.ply", "--n", 4, "--out", tmp_path / "out")
    assert result.exit_code == 1
    assert "none.ply" in error_line(result)


def test_wrong_units_are_suspected(tug_ply, tmp_path):
    result = invoke("render", "--object", tug_ply, "--units", "m", "--n", 4, "--out", tmp_path / "out")
    assert result.exit_code == 1
    assert "did you mean --units" in error_line(result)


def test_a_file_in_the_place_of_the_folder_is_one_line(tug_ply, tmp_path, small_set):
    (tmp_path / "out").write_text("a file")
    result = invoke("render", "--object", tug_ply, "--n", 4, "--out", tmp_path / "out", *small_set)
    assert result.exit_code == 1
    assert "out" in error_line(result)
    result = invoke("bop", "--object", tug_ply, "--frames", 1, "--out", tmp_path / "out", *small_set)
    assert result.exit_code == 1
    assert "out" in error_line(result)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_folder_without_rights_is_one_line(tug_ply, tmp_path, small_set):
    (tmp_path / "locked").mkdir(mode=0o500)
    result = invoke("render", "--object", tug_ply, "--n", 4, "--out", tmp_path / "locked" / "out", *small_set)
    assert result.exit_code == 1
    assert "permission" in error_line(result)


def test_a_foreign_folder_is_left_alone(tug_ply, tmp_path, small_set):
    (tmp_path / "notes.txt").write_text("mine")
    result = invoke("render", "--object", tug_ply, "--n", 4, "--out", tmp_path, *small_set)
    assert result.exit_code == 1
    assert "not empty" in error_line(result)
    assert [p.name for p in tmp_path.iterdir()] == ["notes.txt"]


@pytest.mark.slow
def test_render_and_preview(tug_ply, tmp_path, small_set):
    import cv2

    shards, sheet = tmp_path / "shards", tmp_path / "sheet.png"
    result = invoke("render", "--object", tug_ply, "--n", 5, "--out", shards, "--workers", 1, *small_set)
    assert result.exit_code == 0, result.output
    assert "complete, 5 pairs" in result.stderr
    again = invoke("render", "--object", tug_ply, "--n", 5, "--out", shards, "--workers", 1, *small_set)
    assert again.exit_code == 0
    assert "5 of 5 pairs are there" in again.stderr
    assert invoke("preview", shards, "--out", sheet, "--count", 3, "--first", 2).exit_code == 0
    image = cv2.imread(str(sheet))
    assert image.shape[1] > 1000
    assert image.std() > 20
    result = invoke("preview", shards, "--out", sheet, "--first", 5)
    assert result.exit_code == 1
    assert "no rendered sample from 5 on" in error_line(result)


def test_a_preview_is_spread_over_scenes(tug, config_of, tmp_path, monkeypatch):
    from small_datasets import write_dataset
    from synthgen.inspect import preview

    write_dataset(tmp_path / "shards", config_of("hypotheses_per_scene=4", "shard_size=8"), {1: tug}, 24)
    shown = []
    monkeypatch.setattr(preview, "sample_row", lambda sample, index, meshes: shown.append(index) or preview.title_row())

    def indices(count, first=None):
        shown.clear()
        preview.contact_sheet(str(tmp_path / "shards"), count, first=first)
        return list(shown)

    assert indices(6) == [0, 4, 8, 12, 16, 20]  # one of each scene
    assert indices(3) == [0, 8, 16]
    assert indices(8) == [0, 1, 4, 8, 12, 13, 16, 20]  # more than scenes: further hypotheses of some
    assert indices(100) == list(range(24))
    assert indices(4, first=6) == [6, 7, 8, 9]
    result = invoke("preview", tmp_path / "shards", "--out", tmp_path / "sheet.png", "--count", 2)
    assert result.stderr.splitlines()[0] == "tug.ply: diameter 118.9 mm"


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (("cut", "images", "--out", "a"), "images is now --dataset images"),
        (("export", "shards", "out.h5"), "out.h5 is now --out out.h5"),
        (("info",), "give SHARDS, or --dataset DIR"),
        (("info", "shards", "--dataset", "images"), "give SHARDS, or --dataset DIR"),
        (("info", "--dataset", "nowhere"), "--dataset nowhere: expected a dataset of `synthgen bop`"),
    ],
)
def test_a_bop_dataset_has_its_option_and_shards_are_an_argument(arguments, text):
    result = invoke(*arguments)
    assert result.exit_code == 2
    assert text in result.stderr


def test_every_option_for_a_dataset_has_one_name():
    """Shards are the argument SHARDS, images in BOP layout the option --dataset, in every program."""
    from evalkit.cli import main as evalkit
    from refinenet.cli import main as refinenet

    reading = {
        "evalkit": {name for name, command in evalkit.commands.items() if "--dataset" in options_of(command)},
        "refinenet": {name for name, command in refinenet.commands.items() if "--dataset" in options_of(command)},
        "synthgen": {name for name, command in main.commands.items() if "--dataset" in options_of(command)},
    }
    assert reading["evalkit"] == set(evalkit.commands)
    assert reading["refinenet"] == {"refine", "track"}
    assert reading["synthgen"] == {"cut", "info"}
    shards = {
        name
        for program in (main, refinenet)
        for name, command in program.commands.items()
        if any(p.name == "shards" and p.param_type_name == "argument" for p in command.params)
    }
    assert shards == {"export", "info", "merge", "preview", "train", "verify"}
    for program in (main, refinenet, evalkit):
        for command in program.commands.values():
            names = {p.name for p in command.params if p.param_type_name == "argument"}
            assert names <= {"shards", "source", "a", "b", "renamed"}, command.name


def options_of(command):
    return {option for parameter in command.params for option in parameter.opts}


@pytest.mark.slow
def test_bop_renders_frames(tug_ply, tmp_path, small_set):
    result = invoke("bop", "--object", tug_ply, "--frames", 1, "--out", tmp_path / "bop", *small_set)
    assert result.exit_code == 0, result.output
    assert (tmp_path / "bop/test/000001/rgb/000000.png").is_file()
    assert (tmp_path / "bop/test_targets_bop19.json").is_file()


@pytest.mark.slow
def test_a_mended_setting_may_use_the_folder_of_a_run_that_never_began(tug_ply, tmp_path, small_set):
    """Settings that cannot be drawn leave no folder, whose data card would refuse the ones that can."""
    out = tmp_path / "out"
    render = ["render", "--object", tug_ply, "--n", 4, "--out", out, "--quiet", "--workers", 1, *small_set]
    refused = invoke(*render, "--set", "window.min_area_px=2000")
    assert refused.exit_code != 0
    assert "lower window.min_area_px" in error_line(refused)
    assert not out.exists()
    assert invoke(*render).exit_code == 0
    before = sorted(p.name for p in out.iterdir())
    assert invoke(*render, "--set", "window.min_area_px=2000").exit_code != 0
    assert sorted(p.name for p in out.iterdir()) == before


def test_an_export_that_would_replace_something_says_so_at_once(tmp_path):
    there = tmp_path / "out.h5"
    there.write_text("mine")
    result = invoke("export", tmp_path / "shards", "--out", there)
    assert result.exit_code == 1
    assert "add --overwrite to replace it" in error_line(result)
    assert there.read_text() == "mine"


@pytest.mark.parametrize(("exists", "line"), [(True, "what is rendered stays in"), (False, "nothing is written")])
def test_an_interruption_names_only_a_folder_that_exists(tmp_path, capsys, exists, line):
    if exists:
        (tmp_path / "shards").mkdir()
    with pytest.raises(SystemExit) as ended, resumable(str(tmp_path / "shards")):
        raise KeyboardInterrupt
    assert ended.value.code == 130
    assert line in capsys.readouterr().err


def test_a_mesh_that_takes_seconds_to_read_is_named_before(tug_ply, tmp_path, monkeypatch):
    wrong = ("render", "--object", tug_ply, "--n", 4, "--out", tmp_path / "out", "--set", "distance.min=0.5")
    assert "reading" not in invoke(*wrong).stderr
    monkeypatch.setattr(options, "LARGE_MESH_BYTES", 1000)
    lines = invoke(*wrong).stderr.splitlines()
    assert re.fullmatch(rf"{re.escape(str(tug_ply))}: reading [0-9.]+ kB", lines[0])
    assert "reading" not in invoke(*wrong, "--quiet").stderr
