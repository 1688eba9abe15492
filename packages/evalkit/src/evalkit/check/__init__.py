"""`evalkit check`: all faults of a BOP dataset and of result files, not only the first one."""

from evalkit.check.findings import Findings, Level, Violation
from evalkit.check.run import check

__all__ = ["Findings", "Level", "Violation", "check"]
