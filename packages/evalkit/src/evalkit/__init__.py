"""Scores 6D poses: a BOP dataset and result files in, errors, recalls and a report out."""

from evalkit.evaluate import evaluate

__all__ = ["evaluate"]
__version__ = "0.1.0"
