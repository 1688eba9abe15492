"""Results of a verification: a finding for each check, and the report with all findings."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from synthgen.verify.coverage import Coverage, summary
from synthgen.verify.facts import Facts

FIRST = 10
"""Failed items that a finding lists."""
DATASET_CHECKS: dict[str, tuple[str, str]] = {
    "complete": (
        "Every shard of the data card is in the manifest.",
        "exact, unless --allow-incomplete",
    ),
    "arrays": ("Every array's Zarr metadata (shape, type, codecs) is that of the field table and the card.", "exact"),
    "objects": (
        "Every model is there, with the diameter of the data card.",
        "relative error 1e-5: millimetres are float32",
    ),
    "checksums": ("Every shard decodes, and its files have the SHA-256 of its line in the manifest.", "exact"),
    "manifest": ("Number of samples and of rejected draws in a shard's line equal those of its samples.", "exact"),
    "duplicates": ("No two samples have the same poses and scene patch.", "exact, by hash"),
}
"""Checks of the dataset as a whole: the checked property, and the tolerance."""


@dataclass(frozen=True, kw_only=True)
class Finding:
    """Result of a check.

    Attributes:
        name: Name of the check.
        what: Checked property.
        covered: Number of checked items.
        failed: Number of failed items.
        first: The first failed items.
        items: Kind of the items: samples, shards, files or models.
        worst: Largest measure; None for checks that only pass or fail.
        worst_index: Sample with the largest measure.
        tolerance: Tolerance with its unit, in words.
        why: Reason for the tolerance.
        note: Details of the first failed item.
    """

    name: str
    what: str
    covered: int
    failed: int
    first: tuple[int | str, ...] = ()
    items: str = "samples"
    worst: float | None = None
    worst_index: int | None = None
    tolerance: str = ""
    why: str = ""
    note: str = ""

    @property
    def ok(self) -> bool:
        """Whether nothing fails."""
        return self.failed == 0

    @property
    def text(self) -> str:
        """The finding in one line."""
        mark = "ok  " if self.ok else "FAIL"
        text = f"{mark} {self.name:<28} {self.covered - self.failed:>7} of {self.covered} {self.items}"
        if self.ok:
            worst = "" if self.worst is None else f"worst {self.worst:.3g}, "
            return f"{text:<60} {worst}tolerance {self.tolerance}" if self.tolerance else text
        where = f"not in {self.items} {', '.join(map(str, self.first))}" + (", ..." if self.failed > FIRST else "")
        worst = "" if self.worst is None else f"; worst {self.worst:.3g} in {self.worst_index}"
        tolerance = f", tolerance {self.tolerance}" if self.tolerance else ""
        note = f"; {self.note}" if self.note else ""
        return f"{text}: {where}{worst}{tolerance}{note}"


@dataclass(frozen=True, kw_only=True, eq=False)
class VerificationReport:
    """Verification of a dataset.

    Attributes:
        url: Folder or URL.
        card: Data card.
        digest: Hash of the content.
        committed: Number of committed samples, which were all read.
        rerendered: Number of re-rendered samples.
        gl: GL renderer; None without re-rendered samples.
        findings: Result of each check.
        coverage: Coverage numbers of every sample.
        facts: Reference data.
    """

    url: str
    card: dict[str, Any]
    digest: str
    committed: int
    rerendered: int
    gl: str | None
    findings: tuple[Finding, ...]
    coverage: Coverage
    facts: Facts

    @property
    def ok(self) -> bool:
        """Whether every check passes."""
        return not self.failed

    @property
    def failed(self) -> list[str]:
        """Names of the failed checks."""
        return [finding.name for finding in self.findings if not finding.ok]

    @property
    def text(self) -> str:
        """The findings in lines to read, with a summary of what was checked."""
        return "\n".join([*(finding.text for finding in self.findings), self.extent_text])

    @property
    def extent_text(self) -> str:
        """Number of read and of re-rendered samples in words."""
        text = f"{self.committed} of {self.card['n']} samples are committed and were read"
        return f"{text}, {self.rerendered} were re-rendered with {self.gl}" if self.rerendered else text

    def failed_samples(self) -> list[int]:
        """The first failed samples of every failed check, each once, in the order of the checks."""
        samples = [i for f in self.findings if not f.ok and f.items == "samples" for i in f.first if isinstance(i, int)]
        return list(dict.fromkeys(samples))

    def as_json(self) -> str:
        """The report without the coverage of single samples."""
        content = {
            "dataset": self.url,
            "digest": self.digest,
            "ok": self.ok,
            "samples": self.card["n"],
            "committed": self.committed,
            "rerendered": self.rerendered,
            "gl_renderer": self.gl,
            "checks": [
                {
                    **{k: getattr(f, k) for k in ("name", "ok", "items", "covered", "failed")},
                    "first": list(f.first),
                    "worst": f.worst if f.worst is None or np.isfinite(f.worst) else str(f.worst),
                    "worst_sample": f.worst_index,
                    "tolerance": f.tolerance,
                    "note": f.note,
                }
                for f in self.findings
            ],
            "coverage": summary(self.coverage, self.facts),
        }
        return json.dumps(content, indent=1) + "\n"


def tolerance_text(tolerance: float, unit: str) -> str:
    """A tolerance in words."""
    return "exact" if unit == "flag" or tolerance == 0 else f"{tolerance:g} {unit}".removesuffix(" 1")


def dataset_finding(name: str, items: str, covered: int, wrong: Sequence[int | str]) -> Finding:
    """Finding of a check of the dataset as a whole, with the failed items `wrong`."""
    what, tolerance = DATASET_CHECKS[name]
    return Finding(
        name=name,
        what=what,
        covered=covered,
        failed=len(wrong),
        first=tuple(wrong[:FIRST]),
        items=items,
        tolerance=tolerance,
    )
