"""Scores 6D poses: a BOP dataset and result files in, errors, recalls and a report out."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from evalkit.evaluation.evaluator import evaluate

__all__ = ["evaluate"]
__version__ = "0.1.0"


def __getattr__(name: str) -> Any:
    """`evaluate`, imported when it is asked for: a command that needs none of it should start at once."""
    if name == "evaluate":
        from evalkit.evaluation.evaluator import evaluate

        return evaluate
    raise AttributeError(f"module 'evalkit' has no attribute '{name}'")
