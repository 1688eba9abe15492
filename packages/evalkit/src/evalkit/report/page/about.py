"""Conventions, inputs and versions."""

from collections.abc import Mapping
from typing import Any

CONVENTIONS: Mapping[str, str] = {
    "poses": "a pose maps points of the object into the camera: p_cam = R p_obj + t, as BOP's cam_R_m2c and cam_t_m2c",
    "camera": "x right, y down, z forward (OpenCV); pixel (row i, column j) covers [j, j + 1) x [i, i + 1)",
    "signs": "errors along x, y and z below pictures are estimate minus ground truth; in tables they are without sign",
    "symmetries": "all those of models_info.json, discrete and continuous ones combined",
    "missing": "an expected pose without an estimate is a failure in every fraction and recall, and has VSS 0; means "
    "and medians of errors leave it out",
    "several estimates": "of the estimates of an object in an image, those with the highest scores are used, as many "
    "as the target's inst_count, and each is matched with one ground-truth pose",
    "models": "models_eval where the dataset has it, models otherwise",
}


def inputs(summary: Mapping[str, Any]) -> dict[str, str]:
    """Files with their hashes and sidecars, and versions of the software."""
    dataset = summary["dataset"]
    entries = {f"dataset {dataset['name']}": f"{dataset['path']}, split {dataset['split']}, sha256 {dataset['sha256']}"}
    for file in summary["files"]:
        settings = "; ".join(f"{key} {value}" for key, value in file["sidecar"].items() if key != "dataset")
        entries[file["name"]] = f"{file['path']}, sha256 {file['sha256']}" + (f"; {settings}" if settings else "")
    entries["versions"] = ", ".join(f"{name} {version}" for name, version in summary["versions"].items())
    return entries
