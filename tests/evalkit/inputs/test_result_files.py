"""Result files: sidecars of earlier versions."""

from evalkit.inputs.pairing import pair_up
from evalkit.inputs.result_files import load_result_files
from posecore.bop import write_results


def test_sidecars_of_earlier_versions_are_read(dataset, perfect, tmp_path):
    target = perfect[0]
    ids = {"scene_id": target.scene_id, "im_id": target.im_id, "obj_id": target.obj_id, "gt_index": 0}
    rows = [
        {"line": line, **ids, "angle_deg": angle, "translation_diameter": 0.0, "random": False}
        for line, angle in ((2, 5.0), (3, 10.0))
    ]
    block = {"perturbation": {"rows": rows}}
    write_results(tmp_path / "start.csv", [target] * 2, {"method": "start"} | block)
    write_results(tmp_path / "refined.csv", [target], {"method": "ours", "start_lines": [3]} | block)
    refined, start = tmp_path / "refined.csv", tmp_path / "start.csv"
    files = load_result_files([refined, start], dataset)
    assert [(file.name, file.is_initial) for file in files] == [("start", True), ("refined", False)]
    pairs = pair_up(dataset, files[1]).pairs
    assert [(pair.level.angle_deg, pair.estimate is None) for pair in pairs] == [(5.0, True), (10.0, False)]
