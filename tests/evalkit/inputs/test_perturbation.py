"""Protocols of `evalkit perturb`, and how a report knows whether they were kept."""

import json
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from evalkit.cli import main
from evalkit.inputs.perturbation import PROTOCOLS, PerturbJob, protocol_deviations
from posecore.bop import BopDataset, read_results, read_sidecar
from posecore.bop.perturbation import Level, perturb_dataset
from posecore.errors import ConfigError


def perturb(*arguments):
    return CliRunner().invoke(main, ["perturb", *map(str, arguments)], catch_exceptions=False)


def test_the_papers_protocol_has_angles_of_5_to_45_degrees_and_lengths_of_0_to_1_diameters(dataset_path, tmp_path):
    out = tmp_path / "curve.csv"
    result = perturb("--dataset", dataset_path, "--out", out, "--protocol", "paper")
    assert result.exit_code == 0, result.output
    assert "10 iterations" in result.output
    sidecar = read_sidecar(out)
    levels = Counter((row["angle_deg"], row["translation_diameter"]) for row in sidecar["perturbation"]["rows"])
    expected = [(5.0 * k, 0.0) for k in range(1, 10)] + [(0.0, round(0.1 * k, 1)) for k in range(11)]
    assert levels == dict.fromkeys(expected, 6)  # six poses in the dataset
    assert sidecar["perturbation"]["protocol"] == "paper"
    assert len(read_results(out)) == 6 * 20


def test_the_command_knows_every_protocol():
    (option,) = [option for option in main.commands["perturb"].params if option.name == "protocol"]
    assert list(option.type.choices) == list(PROTOCOLS)


@pytest.mark.parametrize("extra", [("--angles", "5"), ("--translations", "0.1")])
def test_a_protocol_takes_no_levels_beside_its_own(dataset_path, tmp_path, extra):
    result = perturb("--dataset", dataset_path, "--out", tmp_path / "x.csv", "--protocol", "paper", *extra)
    assert result.exit_code == 2
    assert result.stderr == "Error: --protocol paper brings its own levels; leave --angles and --translations away\n"
    assert not (tmp_path / "x.csv").exists()


def test_levels_without_a_protocol_name_none(dataset_path, tmp_path):
    out = tmp_path / "x.csv"
    assert perturb("--dataset", dataset_path, "--out", out, "--angles", "5").exit_code == 0
    assert "protocol" not in json.loads((tmp_path / "x.csv.json").read_text())["perturbation"]


def test_too_few_iterations_depart_from_the_papers_protocol():
    sidecar = {"perturbation": {"protocol": "paper", "rows": []}, "settings": {"iterations": 5}}
    assert protocol_deviations(sidecar) == ["refined in 5 iterations, while protocol 'paper' asks for 10"]
    assert protocol_deviations(sidecar | {"settings": {"iterations": 10}}) == []


@pytest.mark.parametrize(
    "sidecar",
    [
        {},
        {"settings": {"iterations": 5}},
        {"perturbation": {"rows": []}, "settings": {"iterations": 5}},
        {"perturbation": {"protocol": "paper"}},
        {"perturbation": {"protocol": "another"}, "settings": {"iterations": 5}},
        {"perturbation": [], "settings": "fast"},
    ],
)
def test_what_names_no_protocol_departs_from_none(sidecar):
    assert protocol_deviations(sidecar) == []


def test_depth_stretch_moves_random_starts_along_the_ray_alone_and_says_how_far(dataset_path, tmp_path):
    levels = ("--dataset", dataset_path, "--angles", "5", "--random-up-to", "10", "--random-translation", "0.2")
    for name, more in (("plain", ()), ("stretched", ("--depth-stretch", "4"))):
        assert perturb(*levels, "--out", tmp_path / f"{name}.csv", *more).exit_code == 0
    dataset = BopDataset(dataset_path)
    plain, stretched = (read_results(tmp_path / f"{name}.csv") for name in ("plain", "stretched"))
    rows = read_sidecar(tmp_path / "stretched.csv")["perturbation"]["rows"]
    assert len(plain) == len(stretched) == len(rows) == 12
    for before, after, row in zip(plain, stretched, rows, strict=True):
        gt = dataset.gt(before.scene_id, before.im_id)[row["gt_index"]].T_cam_obj
        if not row["random"]:
            assert np.array_equal(before.T_cam_obj, after.T_cam_obj)
            continue
        ray = gt[:3, 3] / np.linalg.norm(gt[:3, 3])
        move, moved = (one.T_cam_obj[:3, 3] - gt[:3, 3] for one in (before, after))
        assert moved @ ray == pytest.approx(4 * (move @ ray), abs=1e-8)
        assert np.cross(moved, ray) == pytest.approx(np.cross(move, ray), abs=1e-8)
        assert np.array_equal(before.T_cam_obj[:3, :3], after.T_cam_obj[:3, :3])
        diameter_m = dataset.models_info[before.obj_id].diameter_m
        assert row["translation_diameter"] == pytest.approx(np.linalg.norm(moved) / diameter_m, abs=1e-6)
    without = perturb("--dataset", dataset_path, "--out", tmp_path / "x.csv", "--angles", "5", "--depth-stretch", "4")
    assert without.exit_code == 2
    assert without.stderr == "Error: --depth-stretch needs a random initial pose; give --random-translation too\n"


def test_a_start_behind_the_camera_names_the_parameter_and_the_command_its_option(dataset_path, tmp_path):
    up_to, dataset, out = Level(angle_deg=0.0, translation_diameter=3.0), BopDataset(dataset_path), tmp_path / "x.csv"
    with pytest.raises(
        ConfigError, match=r"^depth_stretch 20: puts .*; lower it or random_up_to.translation_diameter$"
    ):
        perturb_dataset(dataset, out, levels=(), seed=0, random_up_to=up_to, depth_stretch=20.0)
    with pytest.raises(ConfigError, match=r"^levels and random_up_to: found neither, expected one at least$"):
        perturb_dataset(dataset, out, levels=(), seed=0)
    options = ("--random-up-to", "0", "--random-translation", "3", "--depth-stretch", "20")
    behind = perturb("--dataset", dataset_path, "--out", out, *options)
    assert behind.exit_code == 2
    assert behind.stderr.startswith("Error: --depth-stretch 20: puts object")
    assert behind.stderr.endswith("behind the camera; lower it or --random-translation\n")
    named = perturb("--dataset", tmp_path / "depth_stretch", "--out", out, *options)
    assert str(tmp_path / "depth_stretch") in named.stderr


def test_an_unknown_protocol_is_refused():
    with pytest.raises(ConfigError, match=r"protocol: got 'cvpr', expected one of .*paper"):
        PerturbJob(dataset=Path("dataset"), out=Path("initial.csv"), protocol="cvpr")
