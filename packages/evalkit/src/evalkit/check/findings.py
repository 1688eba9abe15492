"""Findings of a check: violations by kind, the first of each kind kept and all counted."""

import json
from collections import Counter
from dataclasses import asdict, dataclass
from typing import Literal

from posecore.errors import PoseError

Level = Literal["error", "warning", "hint"]
LEVELS: tuple[Level, ...] = ("error", "warning", "hint")


@dataclass(frozen=True, kw_only=True)
class Violation:
    """One violation of a rule.

    Attributes:
        level: error: scores are wrong or impossible; warning: probably unintended; hint: a convention is broken.
        kind: short name of the rule, the same for all its violations.
        where: file, line, image or key.
        message: the value in the file and the expected one.
        hint: probable cause or remedy; empty where the message suffices.
    """

    level: Level
    kind: str
    where: str
    message: str
    hint: str = ""

    def __str__(self) -> str:
        sentence = f"{self.where}: {self.message}" if self.where else self.message
        return f"{sentence} ({self.hint})" if self.hint else sentence


class Findings:
    """Violations: the first ones of each kind, and the counts of all."""

    def __init__(self, limit: int | None = 10) -> None:
        """Start empty.

        Args:
            limit: violations of a kind that are kept; None for all.
        """
        self.limit = limit
        self.violations: list[Violation] = []
        self.counts: Counter[tuple[Level, str]] = Counter()
        self.covered: Counter[str] = Counter()

    def add(self, level: Level, kind: str, where: str, message: str, hint: str = "") -> None:
        """Add a violation."""
        self.counts[level, kind] += 1
        if self.limit is None or self.counts[level, kind] <= self.limit:
            self.violations.append(Violation(level=level, kind=kind, where=where, message=message, hint=hint))

    def add_error(self, kind: str, error: PoseError) -> None:
        """Add the error of a reader, whose message names the file."""
        self.add("error", kind, "", str(error))

    def cover(self, what: str, count: int = 1) -> None:
        """Count checked items: without violations, they are the report's content."""
        self.covered[what] += count

    def total(self, level: Level) -> int:
        """Number of violations of a level."""
        return sum(count for (of_level, _), count in self.counts.items() if of_level == level)

    @property
    def ok(self) -> bool:
        """Whether there are no errors."""
        return self.total("error") == 0

    def lines(self) -> list[str]:
        """One line for each violation kept, errors first, and one for the rest of each kind."""
        lines = []
        for level in LEVELS:
            for kind in dict.fromkeys(v.kind for v in self.violations if v.level == level):
                shown = [v for v in self.violations if (v.level, v.kind) == (level, kind)]
                lines += [f"{level} {kind}: {violation}" for violation in shown]
                if self.counts[level, kind] > len(shown):
                    lines.append(f"{level} {kind}: {self.counts[level, kind] - len(shown)} more like this; see --all")
        return lines

    def summary(self) -> str:
        """Counts in words: violations and checked items."""
        covered = ", ".join(f"{what} {count}" for what, count in self.covered.items())
        violations = ", ".join(_plural(self.total(level), level) for level in LEVELS if self.total(level))
        return f"{violations or 'nothing wrong'}; checked: {covered or 'nothing'}"

    def as_json(self) -> str:
        """All findings as JSON."""
        content = {
            "ok": self.ok,
            "counts": {level: self.total(level) for level in LEVELS},
            "kinds": [
                {"level": level, "kind": kind, "count": count} for (level, kind), count in sorted(self.counts.items())
            ],
            "covered": dict(self.covered),
            "violations": [asdict(violation) for violation in self.violations],
        }
        return json.dumps(content, indent=1) + "\n"


def _plural(count: int, noun: str) -> str:
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"
