"""BOP datasets and result files: read and written, metres inside, millimetres in the files."""

from posecore.bop.dataset import BopDataset, GroundTruth, Target
from posecore.bop.models_info import ModelInfo, load_models_info, symmetry_transforms
from posecore.bop.results import (
    Estimate,
    ResultTable,
    estimates_of,
    read_result_table,
    read_results,
    read_sidecar,
    sidecar_path,
    table_of,
    write_results,
)
from posecore.bop.splits import splits_of
from posecore.bop.writer import (
    BopWriter,
    FrameEntry,
    FrameFiles,
    scene_folder,
    visible_targets,
    write_camera,
    write_models,
    write_targets,
)

__all__ = [
    "BopDataset",
    "BopWriter",
    "Estimate",
    "FrameEntry",
    "FrameFiles",
    "GroundTruth",
    "ModelInfo",
    "ResultTable",
    "Target",
    "estimates_of",
    "load_models_info",
    "read_result_table",
    "read_results",
    "read_sidecar",
    "scene_folder",
    "sidecar_path",
    "splits_of",
    "symmetry_transforms",
    "table_of",
    "visible_targets",
    "write_camera",
    "write_models",
    "write_results",
    "write_targets",
]
