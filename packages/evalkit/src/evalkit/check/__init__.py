"""`evalkit check`: everything that is wrong in a BOP dataset and in result files, not only the first thing."""

from evalkit.check.findings import Findings, Level, Violation
from evalkit.check.run import check

__all__ = ["Findings", "Level", "Violation", "check"]
