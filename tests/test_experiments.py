"""Experiments: every command line is one that its command takes, and one experiment runs from end to end."""

import importlib
import itertools
import json
import runpy
import shlex
import subprocess
import sys
from contextlib import chdir
from pathlib import Path
from unittest.mock import patch

import click
import cv2
import numpy as np
import pytest
from click.testing import CliRunner
from posecore import config as config_tools
from posecore import se3
from posecore.bop import Estimate, load_models_info, read_results, read_sidecar, write_results
from posecore.mesh import load_mesh
from synthgen.config import CutConfig

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
from experiments import common, cups, join, stand_ins
from experiments.chain import ROOT

NAMES = [
    "perturbation_curves",
    "detection_refinement",
    "lmo_add",
    "lmo_flow",
    "loss_ablation",
    "category_level",
    "tracking",
    "symmetric_loss",
    "ablation_plus",
    "speed",
]
SIZES = ["smoke", "small", "full"]
GROUPS = {
    "synthgen": "synthgen.cli:main",
    "refinenet": "refinenet.cli:main",
    "evalkit": "evalkit.cli:main",
}
SCRIPTS = {"cups.py": cups.parser, "join.py": join.parser, "stand_ins.py": stand_ins.parser}


def experiment(name: str) -> common.Experiment:
    return importlib.import_module(f"experiments.{name}").EXPERIMENT


@pytest.fixture
def inputs(tmp_path: Path) -> common.Inputs:
    """Folders of the layout that experiments expect, with nothing in their files."""
    data = tmp_path / "lm o"
    (data / "models").mkdir(parents=True)
    for name in ("models/models_info.json", "models/obj_000001.ply", "models/obj_000005.ply", "init_x.csv"):
        (data / name).touch()
    (tmp_path / "stem.safetensors").touch()
    return common.Inputs(data=data, backbone_weights=tmp_path / "stem.safetensors", backgrounds=data)


def command_of(words: list[str]) -> tuple[click.Command, list[str]]:
    """The command that a line calls, and its arguments."""
    module, name = GROUPS[words[0]].split(":")
    group = getattr(importlib.import_module(module), name)
    found = group.get_command(click.Context(group), words[1])
    assert found is not None, f"{words[0]} has no command {words[1]}"
    return found, words[2:]


def parsed(command: click.Command, arguments: list[str]) -> dict:
    """Values as the command would get them; that files exist is not asked.

    Raises:
        click.UsageError: An unknown option, a missing one, or a value of the wrong type.
    """
    context = click.Context(command)
    values, rest, _ = command.make_parser(context).parse_args(list(arguments))
    assert not rest, f"left over: {rest}"
    for option in command.get_params(context):
        given, _ = option.consume_value(context, values)
        if isinstance(option.type, click.Path):
            assert given or not option.required, f"{option.name} is missing"
        else:
            values[option.name] = option.process_value(context, given)
    return values


def check_settings(program: str, values: dict) -> None:
    """Every preset and every `--set` is one that the program's configuration knows."""
    if "preset" in values and "overrides" in values:
        loader = importlib.import_module(f"{program}.config").load_config
        loader(values["preset"], values["overrides"])
    elif "overrides" in values:
        config_tools.build(CutConfig, config_tools.apply_overrides({}, values["overrides"]), "--set")


def check_line(words: list[str]) -> None:
    if words[0] == "python":
        SCRIPTS[Path(words[1]).name]().parse_args(words[2:])
        return
    command, arguments = command_of(words)
    check_settings(words[0], parsed(command, arguments))


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("name", NAMES)
def test_every_command_line_is_one_that_its_command_takes(name, size, inputs, tmp_path) -> None:
    steps = experiment(name).plan(tmp_path / "a b", size, inputs)
    assert len({step.name for step in steps}) == len(steps)
    assert steps[-1].command[:2] == ("evalkit", "report")
    for step in steps:
        check_line(list(step.command))


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("name", NAMES)
def test_what_a_step_reads_was_made_before(name, size, inputs, tmp_path) -> None:
    work, made = tmp_path / "a b", set()
    for step in experiment(name).plan(work, size, inputs):
        words = list(step.command)
        outs = {words[place + 1] for place, word in enumerate(words) if word in ("--out", "--candidates")}
        read = {word for word in words if word.startswith(str(work))} - outs
        if words[0] != "python" or "cups.py" not in words[1]:
            assert all(any(Path(word).is_relative_to(place) for place in made) for word in read), step.command
        made |= outs | {str(work / step.leaves)} | (read if words[0] == "python" else set())


@pytest.mark.parametrize("name", NAMES)
def test_training_and_test_scenes_differ(name, inputs, tmp_path) -> None:
    for size in SIZES:
        seeds = {"render": set(), "bop": set()}
        for step in experiment(name).plan(tmp_path, size, inputs):
            if step.command[0] == "synthgen" and step.command[1] in seeds:
                seeds[step.command[1]].add(step.command[step.command.index("--seed") + 1])
        assert not seeds["render"] & seeds["bop"]


def test_a_wrong_line_is_found(tmp_path) -> None:
    mesh = ["synthgen", "render", "--object", "a.ply", "--out", "b", "--n"]
    check_line([*mesh, "3"])
    for wrong in ([*mesh, "none"], [*mesh, "3", "--no-such", "1"], mesh[:-1]):
        with pytest.raises(click.UsageError):
            check_line(wrong)
    with pytest.raises(Exception, match="no_such"):
        check_line([*mesh, "3", "--set", "window.no_such=1"])
    with pytest.raises(Exception, match="no_such"):
        check_line(["synthgen", "cut", "--dataset", "a", "--out", "b", "--set", "no_such=1"])


def run_script(name: str, *arguments: object) -> None:
    """Run an experiment's script in this process, as if it were started in a folder of its own."""
    script = ROOT / "experiments" / f"{name}.py"
    path = [str(script.parent), *(entry for entry in sys.path if Path(entry).resolve() != ROOT)]
    argv = [str(script), *map(str, arguments)]
    before = forget_experiments()
    try:
        with patch.object(sys, "path", path), patch.object(sys, "argv", argv), pytest.raises(SystemExit) as ended:
            runpy.run_path(str(script), run_name="__main__")
    finally:
        forget_experiments()
        sys.modules.update(before)
    assert not ended.value.code


def forget_experiments() -> dict:
    """Modules of the experiments, which the next import makes anew."""
    return {name: sys.modules.pop(name) for name in list(sys.modules) if name.partition(".")[0] == "experiments"}


@pytest.mark.parametrize("name", NAMES)
def test_help_and_list_run_nothing(name, inputs, tmp_path, capsys) -> None:
    run_script(name, "--help")
    shown = capsys.readouterr().out
    assert experiment(name).doc.splitlines()[0] in shown and all(f"--{size}" in shown for size in SIZES)
    work = tmp_path / "work"
    run_script(name, work, "--smoke", "--list", "--data", inputs.data)
    lines = [shlex.split(line) for line in capsys.readouterr().out.splitlines()]
    assert lines == [
        list(step.command) for step in experiment(name).plan(work, "smoke", common.Inputs(data=inputs.data))
    ]
    assert not work.exists()


def test_meshes_that_are_missing_are_said(tmp_path) -> None:
    with pytest.raises(SystemExit, match="expected --data"):
        experiment("lmo_add").plan(tmp_path, "small", common.Inputs())
    with pytest.raises(SystemExit, match="no LM-O meshes"):
        experiment("perturbation_curves").plan(tmp_path, "full", common.Inputs(data=tmp_path))


def test_preset_paper_is_trained_on_lmo_where_its_stem_is_given(inputs, tmp_path) -> None:
    trained = {
        given: [step.name for step in experiment("lmo_add").plan(tmp_path, "small", what) if step.run is not None]
        for given, what in (("stem", inputs), ("none", common.Inputs(data=inputs.data)))
    }
    assert trained["stem"] == [*trained["none"], "train-paper"]
    assert len(trained["none"]) == 4


def test_a_file_to_work_in_is_refused(tmp_path, monkeypatch) -> None:
    file = tmp_path / "notes.txt"
    file.write_text("kept")
    monkeypatch.setattr(sys, "argv", ["speed.py", "--smoke", str(file)])
    with pytest.raises(SystemExit, match=r"notes\.txt: is a file, expected a folder to work in"):
        common.run(experiment("speed"))
    assert file.read_text() == "kept"


def in_this_process(command, *, cwd=None, run=subprocess.run, **settings):
    """As `subprocess.run`, but without a process for a command of the project."""
    program = Path(command[0]).name
    if program not in GROUPS:
        return run(command, cwd=cwd, **settings)
    module, name = GROUPS[program].split(":")
    with chdir(cwd or "."):
        result = CliRunner().invoke(getattr(importlib.import_module(module), name), command[1:])
    print(result.output)
    return subprocess.CompletedProcess(command, result.exit_code)


@pytest.mark.slow
def test_perturbation_curves_end_in_a_report_and_a_result(tmp_path) -> None:
    with patch.object(subprocess, "run", in_this_process):
        run_script("perturbation_curves", tmp_path / "work", "--smoke")
    result = json.loads((tmp_path / "work" / "result.json").read_text())
    assert (tmp_path / "work" / "report" / "index.html").is_file()
    assert set(result["methods"]) == {"initial", "shipped", "edge-icp"}
    assert result["methods"]["initial"]["vss_mean"] < result["methods"]["shipped"]["vss_mean"]
    levels = [point["level"] for point in result["curves"]["shipped"]["angle"]]
    assert levels[-1] == 45
    assert len(result["steps"]) == 6
    assert all(step["seconds"] >= 0 for step in result["steps"])  # rounded to tenths


def test_every_method_starts_from_the_same_poses_and_is_in_the_report(tmp_path) -> None:
    what = common.Comparison(
        objects="--object a.ply",
        scenes="",
        frames=2,
        networks={"net": common.SHIPPED["shipped"]},
        baselines=("edge-icp",),
        initial="--angles 5",
    )
    *_, net, edge, tables, report = common.compared(tmp_path, what)
    words = [[word for word in step.command if word != "--keep-failed"] for step in (net, edge)]
    assert [len(step.command) - len(kept) for step, kept in zip((net, edge), words, strict=True)] == [1, 1]
    options = [dict(zip(kept[2::2], kept[3::2], strict=True)) for kept in words]
    initial = str(tmp_path / "results" / "initial.csv")
    assert [each["--init"] for each in options] == [initial, initial]
    assert [each.get("--method") for each in options] == [None, "edge-icp"]
    assert [each.get("--checkpoint") is None for each in options] == [False, True]
    for step in (tables, report):
        named = [word for before, word in itertools.pairwise(step.command) if before == "--results"]
        assert named == [initial, options[0]["--out"], options[1]["--out"]]


def test_parts_join_into_one_result_file(tmp_path) -> None:
    here = se3.make_T(np.eye(3), np.array([0.0, 0.0, 1.0]))
    lines = [Estimate(scene_id=1, im_id=im_id, obj_id=1 + im_id, T_cam_obj=here) for im_id in range(3)]
    parts = [tmp_path / "a_1.csv", tmp_path / "a_2.csv"]
    write_results(
        parts[0], lines[:1], {"dataset": "toy", "initial_lines": [2], "failed_lines": [3], "checkpoint_sha256": "x"}
    )
    write_results(parts[1], lines[1:], {"dataset": "toy", "initial_lines": [4, 5], "failed_lines": []})
    join.join(parts, tmp_path / "a.csv")
    assert [line.obj_id for line in read_results(tmp_path / "a.csv")] == [1, 2, 3]
    sidecar = read_sidecar(tmp_path / "a.csv")
    assert sidecar is not None
    assert (sidecar["method"], sidecar["dataset"]) == ("a", "toy")
    assert (sidecar["initial_lines"], sidecar["failed_lines"]) == ([2, 4, 5], [3])
    assert sidecar["parts"] == {"a_1.csv": "x", "a_2.csv": None}


@pytest.mark.slow
def test_a_category_has_one_diameter_and_an_unseen_member(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(sys, "argv", ["cups.py", str(tmp_path), "--count", "4"])
    assert cups.main() == 0
    trained = sorted((tmp_path / "train").glob("obj_*.ply"))
    (unseen,) = (tmp_path / "unseen").glob("obj_*.ply")
    meshes = [load_mesh(path, units="mm") for path in (unseen, *trained)]
    assert len({mesh.sha256 for mesh in meshes}) == 5
    assert all(abs(mesh.diameter_m - cups.DIAMETER_M) < 1e-5 for mesh in meshes)
    known = load_models_info(tmp_path / "train" / "models_info.json")
    assert [known[number].is_symmetric for number in (1, 2, 3, 4)] == [False, True, False, True]
    symmetric = np.ptp(meshes[2].vertices_m[:, 0]) - np.ptp(meshes[2].vertices_m[:, 1])
    assert abs(symmetric) < 1e-4 < abs(np.ptp(meshes[1].vertices_m[:, 0]) - np.ptp(meshes[1].vertices_m[:, 1]))


def test_stand_ins_differ_from_what_they_stand_for(tmp_path, tug_ply) -> None:
    """Meshes move by well under a hundredth of their size and change colours; boards are among the backgrounds."""
    models = tmp_path / "models"
    models.mkdir()
    (models / "obj_000003.ply").write_bytes(tug_ply.read_bytes())
    (models / "models_info.json").write_text("{}")
    known = load_mesh(models / "obj_000003.ply")
    stand_ins.alter(models, 1, tmp_path / "altered")
    stand_ins.alter(models, 1, tmp_path / "again")
    altered = load_mesh(tmp_path / "altered" / "obj_000003.ply")
    assert (tmp_path / "again" / "obj_000003.ply").read_bytes() == (
        tmp_path / "altered" / "obj_000003.ply"
    ).read_bytes()
    moved = np.linalg.norm(altered.vertices_m - known.vertices_m, axis=1) / np.linalg.norm(
        np.ptp(known.vertices_m, axis=0)
    )
    assert 0.004 < np.sqrt(np.mean(moved**2)) < 0.008
    assert np.abs(altered.colours.astype(float) - known.colours).mean() > 5
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "a.jpg").touch()
    stand_ins.draw_boards(tmp_path / "photos", 0, tmp_path / "behind")
    sheets = [cv2.imread(str(tmp_path / "behind" / f"board{k}.png")) for k in range(stand_ins.BOARDS)]
    assert (tmp_path / "behind" / "a.jpg").exists()
    assert len({sheet.tobytes() for sheet in sheets}) == stand_ins.BOARDS
    assert all(0.2 < (sheet < 100).mean() < 0.7 for sheet in sheets)
    frames = tmp_path / "frames"
    (frames / "models").mkdir(parents=True)
    (frames / "models" / "obj_000009.ply").touch()
    stand_ins.make_known(frames, models)
    assert sorted(p.name for p in (frames / "models").iterdir()) == ["models_info.json", "obj_000003.ply"]
