"""What a verification found: a finding for each check, and the report of all."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from synthgen.verify.coverage import Coverage, summary
from synthgen.verify.facts import Facts

FIRST = 10  # offenders that a finding names
DATASET_CHECKS: dict[str, tuple[str, str]] = {
    "complete": (
        "Every shard of the data card is in the manifest.",
        "exact, unless --allow-incomplete",
    ),
    "arrays": ("Every array's Zarr metadata (shape, type, codecs) is that of the field table and the card.", "exact"),
    "objects": ("Every model is there, with the diameter of the data card.", "1e-5 of it: millimetres in float32"),
    "checksums": ("Every shard decodes, and its files have the SHA-256 of its line in the manifest.", "exact"),
    "manifest": ("Samples and rejected draws of a shard's line are those of its samples.", "exact"),
    "duplicates": ("No two samples have the same poses and scene patch.", "exact, by hash"),
}
"""Checks of the dataset as a whole: what they say, and their tolerance."""


@dataclass(frozen=True, kw_only=True)
class Finding:
    """What one check found.

    Attributes:
        name: Of the check.
        what: What it says.
        covered: Samples (or shards, arrays, models) that were looked at.
        failed: How many of them fail.
        first: The first offenders.
        of: What is counted.
        worst: Largest measure, None where the check only says yes or no.
        worst_index: Sample that has it.
        tolerance: With its unit, in words.
        why: Reason for the tolerance.
        note: More on the first offender.
    """

    name: str
    what: str
    covered: int
    failed: int
    first: tuple[int | str, ...] = ()
    of: str = "samples"
    worst: float | None = None
    worst_index: int | None = None
    tolerance: str = ""
    why: str = ""
    note: str = ""

    @property
    def ok(self) -> bool:
        """Whether nothing fails."""
        return self.failed == 0


@dataclass(frozen=True, kw_only=True, eq=False)
class Report:
    """A verified dataset.

    Attributes:
        url: Where it is.
        card: Its data card.
        digest: Names its content.
        committed: Samples that are there.
        drawn: Samples that were drawn again.
        gl: Renderer that drew them again; None where none were.
        findings: One for each check.
        coverage: Numbers of every sample that was read.
        facts: Objects and camera.
    """

    url: str
    card: dict[str, Any]
    digest: str
    committed: int
    drawn: int
    gl: str | None
    findings: tuple[Finding, ...]
    coverage: Coverage
    facts: Facts

    @property
    def ok(self) -> bool:
        """Whether every check passes."""
        return all(finding.ok for finding in self.findings)

    def failed_samples(self) -> list[int]:
        """The first offenders of every failed check of samples, each once, in the order of the checks."""
        found = [i for f in self.findings if not f.ok and f.of == "samples" for i in f.first if isinstance(i, int)]
        return list(dict.fromkeys(found))

    def as_json(self) -> str:
        """Everything but the samples' own numbers."""
        content = {
            "dataset": self.url,
            "digest": self.digest,
            "ok": self.ok,
            "samples": self.card["n"],
            "committed": self.committed,
            "drawn_again": self.drawn,
            "gl_renderer": self.gl,
            "checks": [
                {
                    **{k: getattr(f, k) for k in ("name", "ok", "of", "covered", "failed")},
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


def dataset_finding(name: str, of: str, covered: int, wrong: Sequence[int | str]) -> Finding:
    """What a check of the dataset as a whole found: `wrong` of the `covered` are."""
    what, tolerance = DATASET_CHECKS[name]
    return Finding(
        name=name,
        what=what,
        covered=covered,
        failed=len(wrong),
        first=tuple(wrong[:FIRST]),
        of=of,
        tolerance=tolerance,
    )
