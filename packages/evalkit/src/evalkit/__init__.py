"""Errors, recalls and reports of 6D poses: BOP datasets and result files in, tables and pages out."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from posecore.renamed import refuse_renamed_modules

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

refuse_renamed_modules(
    {
        "evalkit.attribution": "evalkit.scores.failure_causes",
        "evalkit.bins": "evalkit.scores.bins",
        "evalkit.bootstrap": "evalkit.scores.bootstrap",
        "evalkit.check.pixels": "evalkit.check.images",
        "evalkit.check.scenes": "evalkit.check.annotations",
        "evalkit.check.truth": "evalkit.check.self_test",
        "evalkit.cli.group": "posecore.command_line",
        "evalkit.comparison": "evalkit.report.comparison",
        "evalkit.curves": "evalkit.scores.convergence",
        "evalkit.diff.differences": "evalkit.diff.deltas",
        "evalkit.diff.output": "evalkit.diff.text",
        "evalkit.evaluator": "evalkit.evaluation.evaluator",
        "evalkit.files": "evalkit.inputs.result_files",
        "evalkit.formats": "evalkit.tables.model",
        "evalkit.html": "evalkit.report.html",
        "evalkit.kernels": "evalkit.pose_errors.kernels",
        "evalkit.metrics": "evalkit.pose_errors.metrics",
        "evalkit.nearest": "evalkit.pose_errors.nearest_points",
        "evalkit.page": "evalkit.report.page",
        "evalkit.pairing": "evalkit.inputs.pairing",
        "evalkit.paper": "evalkit.tables.paper",
        "evalkit.perturb": "evalkit.inputs.perturbation",
        "evalkit.pictures": "evalkit.report.pictures",
        "evalkit.plots": "evalkit.report.svg_plots",
        "evalkit.pose_errors.pose_errors": "evalkit.pose_errors.per_object.pose_errors",
        "evalkit.refinement": "evalkit.tables.paper_refinement",
        "evalkit.report.write_report": "evalkit.make_report",
        "evalkit.scored": "evalkit.evaluation.scored_file",
        "evalkit.scorer": "evalkit.pose_errors.scorer",
        "evalkit.scores.bop": "evalkit.scores.bop_matching",
        "evalkit.scores.bop19_shares": "evalkit.scores.bop19_recalls",
        "evalkit.scores.values": "evalkit.scores.per_pose",
        "evalkit.silhouette": "evalkit.pose_errors.silhouettes",
        "evalkit.summary": "evalkit.report.summary",
        "evalkit.summary_tables": "evalkit.tables.report_tables",
        "evalkit.table": "evalkit.error_table",
        "evalkit.tracking.Track": "evalkit.tracking.SequenceTrack",
        "evalkit.tracking.Tracker": "evalkit.tracking.ResettableTracker",
    }
)


def __getattr__(name: str) -> Any:
    """Public names, imported on first use, so that commands start without them."""
    if name in _MODULES:
        return getattr(import_module(_MODULES[name]), name)
    raise AttributeError(f"module 'evalkit' has no attribute '{name}'")
