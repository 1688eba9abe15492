"""Pose refinement: poses in an image by a network or a baseline, and whole BOP result files.

Names are imported on first use, so that the commands need not import torch to print their help.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from refinenet.refine.bop_results import RefineJob, RefineSummary, refine_result_file
    from refinenet.refine.network_refiner import Refiner
    from refinenet.refine.registry import MethodSettings, make_refiner
    from refinenet.refiner import Frame, Refinement, Request

_MODULES = {
    "Frame": "refinenet.refiner",
    "MethodSettings": "refinenet.refine.registry",
    "RefineJob": "refinenet.refine.bop_results",
    "RefineSummary": "refinenet.refine.bop_results",
    "Refinement": "refinenet.refiner",
    "Refiner": "refinenet.refine.network_refiner",
    "Request": "refinenet.refiner",
    "make_refiner": "refinenet.refine.registry",
    "refine_result_file": "refinenet.refine.bop_results",
}

__all__ = [
    "Frame",
    "MethodSettings",
    "RefineJob",
    "RefineSummary",
    "Refinement",
    "Refiner",
    "Request",
    "make_refiner",
    "refine_result_file",
]


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_MODULES[name]), name)
