"""The pipeline: perfect scores for the truth, missing estimates, instances, both kinds of VSS, crops against frames."""

import json
import os
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from evalkit.error_table import column, table_of
from evalkit.evaluation.evaluator import Evaluator
from evalkit.evaluation.scored_file import Scored
from evalkit.inputs.pairing import MatchedPose, pair_up
from evalkit.inputs.result_files import ResultFile, load_result_files
from evalkit.pose_errors import silhouettes
from evalkit.pose_errors.metrics import vss
from evalkit.pose_errors.scorer import Scorer
from evalkit.pose_errors.silhouettes import Patch
from evalkit.report.summary import initial_of
from evalkit.scores import by_object, scores
from evalkit.scores.convergence import by_level
from posecore import se3
from posecore.bop import BopDataset, BopTarget, Estimate, GroundTruth, symmetry_transforms, write_results, write_targets
from posecore.bop import dataset as dataset_module
from posecore.errors import DatasetError, RenderError, ResultFileError
from posecore.mesh import load_mesh

from ..conftest import BOBBIN, CAMERA, IMAGES, TUG


def result_file(tmp_path, dataset, estimates, sidecar=None, name="r.csv"):
    write_results(tmp_path / name, estimates, sidecar)
    return load_result_files([tmp_path / name], dataset)[0]


def in_memory(estimates, sidecar=None):
    return ResultFile(name="r", path=Path("r.csv"), sha256="", sidecar=sidecar or {}, estimates=estimates)


@pytest.mark.parametrize("kind", ["full", "visible"])
def test_truth_scores_perfectly(dataset, perfect, kind):
    with Evaluator(dataset, kind) as evaluator:
        rows = evaluator.evaluate(pair_up(dataset, in_memory(perfect)).pairs)
    assert len(rows) == 6
    assert column(rows, "vss").tolist() == [1.0] * 6
    for name in ("add_m", "adi_m", "mssd_m", "mspd_px", "proj_px", "te_m"):
        assert column(rows, name).max() == 0.0
    assert column(rows, "re_rad").max() < 1e-7
    total = scores(rows)
    assert [total[key] for key in ("vss_mean", "add_recall_0.1d", "adi_auc_100mm", "ar_mssd", "ar_mspd")] == [1.0] * 5
    assert (total["5cm5deg"], total["proj_5px"], total["diverged"], total["missing"]) == (1.0, 1.0, 0.0, 0)


def test_a_scorer_that_knows_the_centres_reads_no_full_model(dataset_path, tmp_path, monkeypatch):
    root = shutil.copytree(dataset_path, tmp_path / "toys")
    shutil.copytree(root / "models", root / "models_eval")
    center_m, read = BopDataset(root).center_m(TUG), []

    def noted(path, **options):
        read.append(path.parent.name)
        return load_mesh(path, **options)

    monkeypatch.setattr(dataset_module, "load_mesh", noted)
    scorer = Scorer(BopDataset(root), visible=False, with_vsd=False)
    scorer.centers_m.update({TUG: center_m})
    np.testing.assert_array_equal(scorer.model(TUG).center_m, center_m)
    scorer.rasteriser.close()
    assert read == ["models_eval"]


@pytest.mark.slow
def test_values_do_not_depend_on_workers_or_blocks(dataset, perfect, monkeypatch):
    rng = np.random.default_rng(1)
    moved = [replace(e, T_cam_obj=se3.perturb(e.T_cam_obj, 0.2, 0.02, rng)) for e in perfect for _ in range(7)]
    pairs = pair_up(dataset, in_memory(perfect[:5])).pairs
    instances = {(pair.scene_id, pair.im_id, pair.gt.obj_id): pair for pair in pairs}
    pairs += [replace(instances[e.scene_id, e.im_id, e.obj_id], estimate=e) for e in rng.permutation(moved)]
    done = []
    with Evaluator(dataset) as one, Evaluator(dataset, workers=2) as two:
        whole = one.evaluate(pairs, done.append)
        parallel = two.evaluate(pairs, done.append)
        monkeypatch.setattr(sys.modules["evalkit.evaluation.evaluator"], "BLOCK", 4)
        monkeypatch.setattr("evalkit.pose_errors.scorer.KEPT_BYTES", 0)
        blocks = one.evaluate(pairs, done.append)
        none = two.evaluate([])
    pd.testing.assert_frame_equal(parallel, whole, check_exact=True)
    pd.testing.assert_frame_equal(blocks, whole, check_exact=True)
    assert whole.found.tolist() == [True] * 5 + [False] + [True] * 42
    assert sum(done) == 3 * len(pairs)
    assert len(none) == 0


@pytest.mark.slow
def test_a_fault_in_a_worker_is_the_error_of_one_process(dataset_path, tmp_path, perfect):
    root = tmp_path / "toys"
    shutil.copytree(dataset_path, root)
    dataset = BopDataset(root)
    pairs = pair_up(dataset, in_memory(perfect)).pairs
    shutil.rmtree(root / "test/000020/depth")
    with Evaluator(dataset, "visible", workers=2) as evaluator, pytest.raises(DatasetError, match="image 1 has no dep"):
        evaluator.evaluate(pairs)


def test_a_worker_that_dies_is_one_line(dataset, perfect, monkeypatch):
    monkeypatch.setattr(sys.modules["evalkit.evaluation.evaluator"], "_start_worker", os.abort)  # takes no arguments
    pairs = pair_up(dataset, in_memory(perfect)).pairs
    with Evaluator(dataset, workers=2) as evaluator, pytest.raises(RenderError, match="again with fewer --workers"):
        evaluator.evaluate(pairs)


def test_known_errors_are_not_computed_again(dataset, perfect, monkeypatch):
    pairs = pair_up(dataset, in_memory(perfect)).pairs
    again = [replace(perfect[0], score=0.1), *perfect]
    with Evaluator(dataset) as evaluator:
        table = evaluator.evaluate(pairs)
        anew = evaluator.all_errors(again)
        scored = []
        plain = evaluator._scorer.score
        monkeypatch.setattr(evaluator._scorer, "score", lambda block: scored.extend(block) or plain(block))
        reused = evaluator.all_errors(again, scored=(pairs, table))
    pd.testing.assert_frame_equal(reused.errors, anew.errors, check_exact=True)
    assert [pair.estimate.score for pair in scored] == [0.1]


def test_symmetric_turns_score_as_the_truth(dataset, perfect):
    turns = symmetry_transforms(dataset.models_info[BOBBIN])
    turned = [replace(e, T_cam_obj=e.T_cam_obj @ turns[97]) for e in perfect if e.obj_id == BOBBIN]
    others = [e for e in perfect if e.obj_id == TUG]
    with Evaluator(dataset) as evaluator:
        rows = evaluator.evaluate(pair_up(dataset, in_memory(turned + others)).pairs)
    bobbins = rows[rows.obj_id == BOBBIN]
    assert column(bobbins, "mssd_m").max() < 1e-9
    assert column(bobbins, "mspd_px").max() < 1e-6
    assert column(bobbins, "re_sym_rad").max() < 1e-6
    assert column(bobbins, "re_rad").min() > 1.0
    assert column(bobbins, "adi_m").max() < 0.02 * bobbins.diameter_m.iloc[0]
    assert column(bobbins, "vss").min() > 0.97
    assert by_object(rows)[BOBBIN]["5cm5deg"] == 1.0


def test_missing_estimates_are_failures_beside_the_mean_over_found(dataset, perfect):
    with Evaluator(dataset) as evaluator:
        rows = evaluator.evaluate(pair_up(dataset, in_memory(perfect[:4])).pairs)
    total = scores(rows)
    assert (total["expected"], total["found"], total["missing"]) == (6, 4, 2)
    assert total["vss_mean"] == pytest.approx(4 / 6)
    assert total["vss_mean_found"] == 1.0
    assert total["add_recall_0.1d"] == total["ar_mssd"] == total["add_auc_100mm"] == pytest.approx(4 / 6)
    assert total["diverged"] == pytest.approx(2 / 6)
    assert total["re_deg_mean"] < 1e-5


def test_only_the_best_scored_estimate_counts(dataset, perfect):
    worse = replace(perfect[0], T_cam_obj=perfect[1].T_cam_obj, score=0.5)
    pairing = pair_up(dataset, in_memory([worse, *perfect]))
    assert pairing.ignored == 1
    assert pairing.pairs[0].estimate is perfect[0]


def test_instances_take_the_nearest_free_truth(dataset_path, tmp_path):
    root = tmp_path / "toys"
    shutil.copytree(dataset_path, root)
    file = root / "test/000004/scene_gt.json"
    content = json.loads(file.read_text())
    second = json.loads(json.dumps(content["0"][0]))
    second["cam_t_m2c"][0] += 40.0
    content["0"].append(second)
    file.write_text(json.dumps(content))
    (root / "test/000004/scene_gt_info.json").unlink()
    write_targets(root, "test", [BopTarget(scene_id=4, im_id=0, obj_id=TUG, inst_count=2)])
    dataset = BopDataset(root)
    first, third = (gt for gt in dataset.gt(4, 0) if gt.obj_id == TUG)
    estimates = [
        Estimate(scene_id=4, im_id=0, obj_id=TUG, score=score, T_cam_obj=gt.T_cam_obj)
        for score, gt in ((0.9, third), (0.8, first))
    ]
    pairs = pair_up(dataset, in_memory(estimates)).pairs
    assert {(pair.gt.gt_index, pair.estimate.score) for pair in pairs} == {(2, 0.9), (0, 0.8)}
    pairs = pair_up(dataset, in_memory(estimates[:1])).pairs
    assert [(pair.gt.gt_index, pair.estimate is None) for pair in pairs] == [(2, False), (0, True)]


def test_target_without_truth_is_an_error(dataset_path, tmp_path, perfect):
    root = tmp_path / "toys"
    shutil.copytree(dataset_path, root)
    write_targets(root, "test", [BopTarget(scene_id=4, im_id=0, obj_id=3)])
    with pytest.raises(DatasetError, match=r"scene_gt.json: image 0 has no pose of object 3"):
        pair_up(BopDataset(root), in_memory(perfect))


def test_unknown_ids_name_file_and_line(dataset, perfect, tmp_path):
    for changes, message in (
        ({"scene_id": 5}, "scene 5 is not in"),
        ({"im_id": 77}, "image 77 has no ground truth in"),
        ({"obj_id": 2}, "object 2 is unknown, toys has 1, 5"),
    ):
        estimates = [perfect[0], replace(perfect[1], **changes)]
        with pytest.raises(ResultFileError) as caught:
            result_file(tmp_path, dataset, estimates)
        assert str(caught.value).startswith(f"{tmp_path / 'r.csv'}:3: ")
        assert message in str(caught.value)


def test_visible_vss_needs_depth(dataset_path, tmp_path, perfect):
    root = tmp_path / "toys"
    shutil.copytree(dataset_path, root)
    shutil.rmtree(root / "test/000020/depth")
    dataset = BopDataset(root)
    with Evaluator(dataset, "visible") as evaluator, pytest.raises(DatasetError, match="image 1 has no depth"):
        evaluator.evaluate(pair_up(dataset, in_memory(perfect)).pairs)


def test_crops_are_the_full_frame(dataset, perfect):
    """Tiles give exactly the pixels of a full render, also across the image's border and far outside."""
    mesh = dataset.mesh(TUG)
    rng = np.random.default_rng(3)
    poses = [e.T_cam_obj for e in perfect if e.obj_id == TUG]
    poses += [se3.make_T(se3.random_rotation(rng), np.array([x, y, 0.5])) for x in (-0.2, 0.2) for y in (-0.15, 0.12)]
    poses += [se3.make_T(np.eye(3), np.array([5.0, 0.0, 0.5])), se3.make_T(np.eye(3), np.array([0.0, 0.0, 0.02]))]
    size = (CAMERA.width_px, CAMERA.height_px)
    with Evaluator(dataset) as evaluator:
        evaluator.mesh(TUG)
        patches = [silhouettes.render_patch(evaluator.rasteriser, TUG, mesh.vertices_m, CAMERA, T) for T in poses]
        frames = evaluator.rasteriser.render(TUG, CAMERA.K, np.stack(poses), *size, rgb=False).mask
    for patch, frame in zip(patches, frames, strict=True):
        rows, columns = patch.depth_m.shape
        pasted = np.zeros_like(frame)
        pasted[patch.y0_px : patch.y0_px + rows, patch.x0_px : patch.x0_px + columns] = patch.depth_m > 0
        assert np.count_nonzero(pasted != frame) <= 2
    assert patches[-2].depth_m.size == 0


def test_vss_of_patches_is_vss_of_frames():
    rng = np.random.default_rng(0)
    for _ in range(30):
        frames, patches = [], []
        for _ in range(2):
            x, y, w, h = rng.integers(0, 20), rng.integers(0, 20), rng.integers(1, 12), rng.integers(1, 12)
            frame = np.zeros((40, 40), bool)
            frame[y : y + h, x : x + w] = True
            frames.append(frame)
            patches.append(Patch(depth_m=np.ones((h, w), np.float32), x0_px=int(x), y0_px=int(y)))
        assert silhouettes.vss_full(*patches) == vss(*frames)
    nothing = Patch(depth_m=np.zeros((0, 0), np.float32), x0_px=0, y0_px=0)
    assert silhouettes.vss_full(nothing, nothing) == 0.0
    assert silhouettes.vss_full(nothing, patches[0]) == 0.0


def test_levels_pair_by_start_line_and_by_order(dataset, perfect):
    gt = perfect[0]
    rows = [
        {
            "line": 2 + index,
            "scene_id": gt.scene_id,
            "im_id": gt.im_id,
            "obj_id": gt.obj_id,
            "gt_index": 0,
            "angle_deg": angle,
            "translation_diameter": 0.0,
            "random": False,
        }
        for index, angle in enumerate((5.0, 10.0, 20.0))
    ]
    block = {"perturbation": {"rows": rows}}
    in_order = pair_up(dataset, in_memory([gt] * 3, block)).pairs
    assert [pair.level.angle_deg for pair in in_order] == [5.0, 10.0, 20.0]
    two = pair_up(dataset, in_memory([gt] * 2, block | {"initial_lines": [4, 2]})).pairs
    assert [pair.estimate is None for pair in two] == [False, True, False]
    with pytest.raises(ResultFileError, match="2 estimates of object 1 in scene 4, image 0, but 3 initial poses"):
        pair_up(dataset, in_memory([gt] * 2, block))
    with Evaluator(dataset) as evaluator:
        curve = by_level(evaluator.evaluate(two))["angle"]
    assert [(point["level"], point["under_5deg"], point["diverged"]) for point in curve] == [
        (5.0, 1.0, 0.0),
        (10.0, 0.0, 1.0),
        (20.0, 1.0, 0.0),
    ]


def test_a_file_is_compared_with_the_start_poses_it_came_from():
    def scored(name, **sidecar):
        file = ResultFile(name=name, path=Path(f"{name}.csv"), sha256="", sidecar=sidecar, estimates=[])
        none = np.zeros((0, 4, 4))
        return Scored(file=file, table=table_of({}), T_est=none, T_gt=none, center_m=np.zeros((0, 3)), ignored=0)

    initial_poses = [scored("near", method="initial"), scored("far", method="initial")]
    assert initial_of(scored("a", init="far.csv"), initial_poses) is initial_poses[1]
    assert initial_of(scored("b", init="gone.csv"), initial_poses) is initial_poses[0]
    assert initial_of(scored("c"), initial_poses) is initial_poses[0]


def test_a_ball_is_scored_without_sampling_error(dataset_path, tmp_path, perfect):
    root = tmp_path / "toys"
    shutil.copytree(dataset_path, root)
    file = root / "models/models_info.json"
    info = json.loads(file.read_text())
    axes = [{"axis": axis, "offset": [0, 0, 0]} for axis in ([1, 0, 0], [0, 1, 0])]
    info[str(TUG)]["symmetries_continuous"] = axes
    file.write_text(json.dumps(info))
    dataset = BopDataset(root)
    rng = np.random.default_rng(0)
    gt = next(gt for gt in dataset.gt(*IMAGES[0]) if gt.obj_id == TUG)
    turned = se3.make_T(se3.random_rotation(rng), gt.T_cam_obj[:3, 3])
    estimate = replace(perfect[0], T_cam_obj=turned, obj_id=TUG)
    pair = MatchedPose(scene_id=IMAGES[0][0], im_id=IMAGES[0][1], gt=gt, estimate=estimate)
    with Evaluator(dataset) as evaluator:
        row = evaluator.evaluate([pair]).iloc[0]
    assert row.mssd_m < 1e-9
    assert row.re_sym_rad < 1e-6
    assert isinstance(gt, GroundTruth)
