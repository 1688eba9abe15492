"""What a check found: violations by kind, each with its place, bounded in number and counted in full."""

import json
from collections import Counter
from dataclasses import asdict, dataclass
from typing import Literal

from posecore.errors import PoseError

Level = Literal["error", "warning", "hint"]
LEVELS: tuple[Level, ...] = ("error", "warning", "hint")


@dataclass(frozen=True, kw_only=True)
class Violation:
    """One thing that is wrong.

    Attributes:
        level: error: numbers will be wrong or cannot be had; warning: probably not meant; hint: a custom is broken.
        kind: short name of the rule, the same for all its violations.
        where: file, line, image or key.
        message: what was found and what is right.
        hint: what may be behind it or what to do; empty where the message says all.
    """

    level: Level
    kind: str
    where: str
    message: str
    hint: str = ""

    def __str__(self) -> str:
        said = f"{self.where}: {self.message}" if self.where else self.message
        return f"{said} ({self.hint})" if self.hint else said


class Findings:
    """Collects violations; of each kind the first ones are kept and all are counted."""

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
        """Note a violation."""
        self.counts[level, kind] += 1
        if self.limit is None or self.counts[level, kind] <= self.limit:
            self.violations.append(Violation(level=level, kind=kind, where=where, message=message, hint=hint))

    def add_error(self, kind: str, error: PoseError) -> None:
        """Note what a reader refused; its message names the place."""
        self.add("error", kind, "", str(error))

    def cover(self, what: str, count: int = 1) -> None:
        """Count what was looked at, so that a report of nothing found says how much that means."""
        self.covered[what] += count

    def total(self, level: Level) -> int:
        """How many violations of a level there are."""
        return sum(count for (of_level, _), count in self.counts.items() if of_level == level)

    @property
    def ok(self) -> bool:
        """Whether there is no error."""
        return self.total("error") == 0

    def lines(self) -> list[str]:
        """One line for each violation that is kept, errors first, and one for what is left out of each kind."""
        lines = []
        for level in LEVELS:
            for kind in dict.fromkeys(v.kind for v in self.violations if v.level == level):
                shown = [v for v in self.violations if (v.level, v.kind) == (level, kind)]
                lines += [f"{level} {kind}: {violation}" for violation in shown]
                if self.counts[level, kind] > len(shown):
                    lines.append(f"{level} {kind}: {self.counts[level, kind] - len(shown)} more like this; see --all")
        return lines

    def summary(self) -> str:
        """Counts in words: what was looked at and how much was found."""
        seen = ", ".join(f"{what} {count}" for what, count in self.covered.items())
        found = ", ".join(_plural(self.total(level), level) for level in LEVELS if self.total(level))
        return f"{found or 'nothing wrong'}; looked at: {seen or 'nothing'}"

    def as_json(self) -> str:
        """Everything, for programs."""
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
