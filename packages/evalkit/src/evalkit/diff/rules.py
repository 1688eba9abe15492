"""Rules such as `vss < -0.01` for unacceptable differences: for `--fail-if` and continuous integration."""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from operator import ge, gt, le, lt
from typing import Literal

from posecore.errors import ConfigError

from evalkit.diff.deltas import Change, Difference
from evalkit.diff.measures import MEASURES

OPERATORS: Mapping[str, Callable[[float, float], bool]] = {"<=": le, ">=": ge, "<": lt, ">": gt}
COUNTS: Mapping[str, str] = {
    "newly_failed": "poses solved in A and failed in B",
    "newly_solved": "poses failed in A and solved in B",
    "lost": "poses found in A only",
    "gained": "poses found in B only",
    "unpaired": "poses expected in only one file",
}
Statistic = Literal["mean", "median", "lower", "upper"]
STATISTICS: Mapping[Statistic, str] = {
    "mean": "of the deltas B - A, also where none is named",
    "median": "of the deltas",
    "lower": "end of the mean delta's 95 % interval",
    "upper": "end of the mean delta's 95 % interval",
}
NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
RULE = re.compile(
    rf"\s*(?:(?P<statistic>\w+)\s*\(\s*(?P<inner>\w+)\s*\)|(?P<name>\w+))\s*(?P<operator><=|>=|<|>)\s*"
    rf"(?P<limit>{NUMBER})\s*"
)


@dataclass(frozen=True, kw_only=True)
class Rule:
    """A rule.

    Attributes:
        text: as written.
        statistic: of a measure's deltas.
        name: a measure, or a count.
        operator: of `OPERATORS`.
        limit: in the measure's unit.
    """

    text: str
    statistic: Statistic
    name: str
    operator: str
    limit: float


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """Result of a rule: its value (NaN for none) and whether the rule fired."""

    rule: Rule
    value: float
    fired: bool

    @property
    def words(self) -> str:
        """One line."""
        if self.value != self.value:
            return f"'{self.rule.text}' cannot be judged: there is no such value, so it counts as failed"
        is_so = "is so" if self.fired else "is not so"
        return f"'{self.rule.text}' {is_so}: {self.value:.6g}"


def parse_rule(text: str) -> Rule:
    """Read `NAME OPERATOR NUMBER` or `STATISTIC(NAME) OPERATOR NUMBER`.

    Raises:
        ConfigError: the text is not a rule, or its name or statistic is unknown; the message lists the valid ones.
    """
    match = RULE.fullmatch(text)
    if match is None:
        raise ConfigError(
            f"--fail-if '{text}': expected NAME OPERATOR NUMBER such as 'vss < -0.01' or 'lower(recall) < -0.02'; "
            f"operators are {', '.join(OPERATORS)}; {_names()}"
        )
    statistic, name = match["statistic"] or "mean", match["inner"] or match["name"]
    if statistic not in STATISTICS or name not in (*MEASURES, *COUNTS):
        unknown = statistic if statistic not in STATISTICS else name
        raise ConfigError(f"--fail-if '{text}': '{unknown}' is unknown; {_names()}")
    if name in COUNTS and match["statistic"]:
        raise ConfigError(f"--fail-if '{text}': {name} is a number of poses; write '{name} {match['operator']} N'")
    chosen: Statistic = next(statistic_name for statistic_name in STATISTICS if statistic_name == statistic)
    return Rule(text=text.strip(), statistic=chosen, name=name, operator=match["operator"], limit=float(match["limit"]))


def _names() -> str:
    return f"names are {', '.join((*MEASURES, *COUNTS))}; statistics are {', '.join(STATISTICS)}"


def judge(rules: Sequence[Rule], difference: Difference) -> list[Verdict]:
    """Verdicts on rules. A rule without a value (nothing found in both, no interval) counts as fired."""
    verdicts = []
    for rule in rules:
        value = _value(rule, difference)
        fired = value != value or OPERATORS[rule.operator](value, rule.limit)
        verdicts.append(Verdict(rule=rule, value=value, fired=bool(fired)))
    return verdicts


def _value(rule: Rule, difference: Difference) -> float:
    if rule.name in COUNTS:
        return float(difference.counts[rule.name])
    change: Change = difference.changes[rule.name]
    if rule.statistic == "mean":
        return change.mean_delta
    if rule.statistic == "median":
        return change.median_delta
    if change.mean_interval is None:
        return float("nan")
    return change.mean_interval[0 if rule.statistic == "lower" else 1]
