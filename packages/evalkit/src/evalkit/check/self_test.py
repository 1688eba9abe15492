"""Ground truth against itself, through the evaluation that reports use: VSS 1, recall 1, every error exactly 0."""

import numpy as np
from posecore.bop import BopDataset, Estimate
from posecore.errors import PoseError

from evalkit.check.annotations import Image, Scenes
from evalkit.check.findings import Findings

ERRORS = ("add_m", "adi_m", "mssd_m", "mspd_px", "proj_px", "proj_sym_px", "re_rad", "re_sym_rad", "te_m")


def check_ground_truth(dataset: BopDataset, scenes: Scenes, images: list[Image], findings: Findings) -> None:
    """Evaluate the ground-truth poses of some images as if they were estimates."""
    from evalkit.evaluation.evaluator import Evaluator
    from evalkit.inputs.pairing import MatchedPose

    pairs = []
    for image in images:
        for gt in scenes.instances.get(image, []):
            if gt.has_pose and scenes.of_center(gt)[2, 3] > 0:
                estimate = Estimate(scene_id=image[0], im_id=image[1], obj_id=gt.obj_id, T_cam_obj=gt.T_cam_obj.copy())
                pairs.append(MatchedPose(scene_id=image[0], im_id=image[1], gt=gt, estimate=estimate))
    if not pairs:
        return
    try:
        with Evaluator(dataset) as evaluator:
            table = evaluator.evaluate(pairs)
    except PoseError as error:
        findings.add_error("self-test", error)
        return
    for row in table.itertuples(index=False):
        where = f"{dataset.annotation(row.scene_id, 'gt')}, image {row.im_id}, entry {row.gt_index}"
        wrong = [f"{name} is {getattr(row, name):.3g}" for name in ERRORS if getattr(row, name) != 0]
        outside = row.visib_fract == 0 and row.vss == 0  # wholly outside the image: no silhouettes to compare
        if row.vss != 1 and not outside:
            wrong.append(f"VSS is {row.vss:.6g}")
        if wrong:
            message = f"evaluated against itself, {', '.join(wrong)}, expected errors 0 and VSS 1"
            findings.add("error", "self-test", where, message)
    recall = float(np.mean(table.found & (table.add_m <= 0.1 * table.diameter_m)))
    if recall != 1:
        findings.add("error", "self-test", str(dataset.split_path), f"recall is {recall:.6g}, expected 1")
    findings.cover("poses against themselves", len(table))
