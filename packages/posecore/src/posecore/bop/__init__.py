"""BOP datasets and result files: read and written, metres inside, millimetres in the files."""

from posecore.bop.dataset import BopDataset, BopTarget, GroundTruth
from posecore.bop.models_info import ModelInfo, load_models_info, symmetry_transforms
from posecore.bop.results import (
    Estimate,
    ResultTable,
    estimate_table,
    estimates_of,
    read_result_table,
    read_results,
    read_sidecar,
    sidecar_path,
    write_results,
)
from posecore.bop.splits import splits_of
from posecore.bop.writer import (
    BopWriter,
    FrameEntry,
    FrameFiles,
    FrameRecord,
    scene_folder,
    visible_targets,
    write_camera,
    write_models,
    write_targets,
)

__all__ = [
    "BopDataset",
    "BopTarget",
    "BopWriter",
    "Estimate",
    "FrameEntry",
    "FrameFiles",
    "FrameRecord",
    "GroundTruth",
    "ModelInfo",
    "ResultTable",
    "estimate_table",
    "estimates_of",
    "load_models_info",
    "read_result_table",
    "read_results",
    "read_sidecar",
    "scene_folder",
    "sidecar_path",
    "splits_of",
    "symmetry_transforms",
    "visible_targets",
    "write_camera",
    "write_models",
    "write_results",
    "write_targets",
]
