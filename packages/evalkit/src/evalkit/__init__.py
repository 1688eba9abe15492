"""Errors, recalls and reports of 6D poses: BOP datasets and result files in, tables and pages out."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from evalkit.evaluation.evaluator import evaluate
    from evalkit.report.job import ReportJob, make_report

__all__ = ["ReportJob", "evaluate", "make_report"]
__version__ = "0.1.0"

_MODULES = {
    "ReportJob": "evalkit.report.job",
    "evaluate": "evalkit.evaluation.evaluator",
    "make_report": "evalkit.report.job",
}


def __getattr__(name: str) -> Any:
    """Public names, imported on first use, so that commands start without them."""
    if name in _MODULES:
        return getattr(import_module(_MODULES[name]), name)
    raise AttributeError(f"module 'evalkit' has no attribute '{name}'")
