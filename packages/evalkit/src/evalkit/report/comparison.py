"""Change between two result files, pose by pose: numbers with intervals, and the same in words."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from evalkit.error_table import column
from evalkit.evaluation.scored_file import Scored
from evalkit.scores import found_errors
from evalkit.scores.bootstrap import Interval, Resampling, resample, units_of
from evalkit.scores.per_pose import solved

Change = dict[str, Any]
COMPARED: Mapping[str, str] = {
    "re_sym_deg": "rotation error",
    "tx_mm": "x error",
    "ty_mm": "y error",
    "tz_mm": "z error",
    "add_mm": "ADD",
}
"""Errors whose medians are compared, and their names."""
FRACTIONS: Mapping[str, str] = {"vss_mean": "mean VSS", "add_s_recall": "ADD(-S) recall at 0.1 diameter"}
"""Scores whose means are compared."""
NO_ERROR = 1e-4
"""Degrees and millimetres, above the rounding of a result file's nine decimals."""
MINUS = "\N{MINUS SIGN}"


def compare(reference: Scored, other: Scored, *, resamples: int = 1000, seed: int = 0) -> dict[str, Any]:
    """Medians, mean VSS and recall of two files over the same poses, the changes with 95 % intervals, and in words.

    Intervals are of the paired change: both files' poses of a scene (or image, see `evalkit.scores.bootstrap`) are
    drawn together.

    Args:
        reference: initial poses, or another file.
        other: file compared with the reference.
        resamples: of the bootstrap.
        seed: of the bootstrap.

    Returns:
        `name`, `reference` (its name), `is_initial` (of the reference), `poses` (found in both), `missing` (in the
        other file), `medians` by error with `poses`, `reference`, `refined`, `ratio`, `difference`, `interval`;
        `vss_mean` and `add_s_recall` with the same but for the ratio; `resampled` (units in words); `headline`;
        `verdict` (scores that are better, worse, or without significant change; empty without intervals); `changes`, a
        phrase for each number; and `words`, the whole text. Values without data are NaN.
    """
    reference_cases, other_cases = reference.cases(), other.cases()
    rows = np.array([(reference_cases[key], row) for key, row in other_cases.items() if key in reference_cases])
    rows = rows.reshape(-1, 2).astype(np.int64)
    all_before, all_after = reference.table.iloc[rows[:, 0]], other.table.iloc[rows[:, 1]]
    both = all_before.found.to_numpy() & all_after.found.to_numpy()
    before, after = all_before[both], all_after[both]
    drawn, all_drawn = (resample(units_of(table), resamples, seed) for table in (before, all_before))
    old, new = found_errors(before), found_errors(after)
    compared: dict[str, Any] = {
        "name": other.file.name,
        "reference": reference.file.name,
        "is_initial": reference.file.is_initial,
        "poses": len(after),
        "missing": int((~other.table.found).sum()),
        "medians": {name: _medians(old[name], new[name], drawn) for name in COMPARED},
        "vss_mean": _means(column(before, "vss"), column(after, "vss"), drawn),
        "add_s_recall": _means(_fractions(solved(all_before)), _fractions(solved(all_after)), all_drawn),
        "resampled": drawn.units.text,
    }
    compared["headline"] = _headline(compared)
    compared["verdict"] = _verdict(compared)
    compared["changes"] = _changes(compared) if len(after) else []
    compared["words"] = _words(compared)
    return compared


def _fractions(flags: Bool[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    return flags.astype(np.float64)


def _medians(old: Float[np.ndarray, " n"], new: Float[np.ndarray, " n"], drawn: Resampling) -> Change:
    """Medians over poses with an initial error of this kind, which initial poses that are only translated have not."""
    off = old > NO_ERROR
    if not off.any():
        nothing = float("nan")
        return {"poses": 0, "reference": nothing, "refined": nothing, "ratio": nothing, "difference": nothing} | {
            "interval": None
        }
    old, new = np.where(off, old, np.nan), np.where(off, new, np.nan)
    before, after = float(np.nanmedian(old)), float(np.nanmedian(new))
    interval = drawn.ends(drawn.medians(new) - drawn.medians(old), drawn.units_with(old))
    counts = {"poses": int(off.sum()), "reference": before, "refined": after, "ratio": after / before}
    return counts | {"difference": after - before, "interval": interval}


def _means(old: Float[np.ndarray, " n"], new: Float[np.ndarray, " n"], drawn: Resampling) -> Change:
    if not len(old):
        nothing = float("nan")
        return {"reference": nothing, "refined": nothing, "difference": nothing, "interval": None}
    before, after = float(old.mean()), float(new.mean())
    interval = drawn.ends(drawn.means((new - old)[None])[0], drawn.units.count)
    return {"reference": before, "refined": after, "difference": after - before, "interval": interval}


def _headline(compared: Change) -> str:
    name, reference, count = compared["name"], compared["reference"], compared["poses"]
    if not count:
        return f"{name} and {reference} have no pose in common."
    against = f"its initial poses ({reference})" if compared["is_initial"] else reference
    poses = "the pose" if count == 1 else f"the {count} poses"
    return f"{name} against {against}, medians over {poses} found in both"


def _verdict(compared: Change) -> str:
    """Scores that are better, worse or neither, by their intervals."""
    labels_by_verdict: dict[str, list[str]] = {"better": [], "worse": [], "no significant change": []}
    errors = [(label, compared["medians"][key]["interval"], -1) for key, label in COMPARED.items()]
    scores = [(label, compared[key]["interval"], 1) for key, label in FRACTIONS.items()]
    for label, interval, sign in (*errors, *scores):
        if interval is not None:
            better = (interval[0] > 0.0) if sign > 0 else (interval[1] < 0.0)
            labels_by_verdict[
                "no significant change" if contains_zero(interval) else "better" if better else "worse"
            ].append(label)
    parts = [f"{name}: {', '.join(labels)}." for name, labels in labels_by_verdict.items() if labels]
    return " ".join(part[0].upper() + part[1:] for part in parts)


def _changes(compared: Change) -> list[str]:
    whose = "the initial one" if compared["is_initial"] else f"that of {compared['reference']}"
    phrases = []
    for key, label in COMPARED.items():
        values = compared["medians"][key]
        if not values["poses"]:
            continue
        unit = "°" if key.endswith("_deg") else " mm"
        few = f", {values['poses']} poses" if values["poses"] < compared["poses"] else ""
        numbers = f"{values['reference']:.3g}{unit} to {values['refined']:.3g}{unit}{few}{_difference(values, unit)}"
        phrases.append(f"{label} {_relative(values, whose)} ({numbers})")
    for key, factor, unit, style in (("vss_mean", 1.0, "", ".3f"), ("add_s_recall", 100.0, " %", ".1f")):
        values = compared[key]
        before, after = (format(factor * values[side], style) for side in ("reference", "refined"))
        change = _difference(values, unit and " points", factor, style)
        verdict = "no significant change, " if contains_zero(values["interval"]) else ""
        phrases.append(f"{FRACTIONS[key]} {verdict}{before}{unit} to {after}{unit}{change}")
    return phrases


def _relative(values: Change, whose: str) -> str:
    if contains_zero(values["interval"]):
        return "no significant change"
    ratio = values["ratio"]
    if values["interval"] is None and abs(ratio - 1.0) < 0.02:
        return f"about the same, {ratio:.2f} of {whose}"
    return f"{'down to' if ratio < 1 else 'up to'} {ratio:.2f} of {whose}"


def contains_zero(interval: Interval) -> bool:
    """Whether an interval of a change contains zero; False without an interval."""
    return interval is not None and interval[0] <= 0.0 <= interval[1]


def _difference(values: Change, unit: str, factor: float = 1.0, style: str = "") -> str:
    """`, change −21.9° [−24.0, −19.8]`, all rounded to the same digit; empty without an interval."""
    if values["interval"] is None:
        return ""
    numbers = [factor * number for number in (values["difference"], *values["interval"])]
    style = style or _style(max(abs(number) for number in numbers))
    value, low, high = (signed(number, style) for number in numbers)
    return f", change {value}{unit} [{low}, {high}]"


def _style(largest: float) -> str:
    """Decimals that leave three digits of the largest number."""
    return f".{min(4, max(0, 2 - int(np.floor(np.log10(largest)))))}f" if largest > 0 else ".0f"


def signed(number: float, style: str) -> str:
    """A number with its sign; zero without."""
    text = format(abs(number), style)
    if not float(text):
        return text
    return f"{'+' if number > 0 else MINUS}{text}"


def _words(compared: Change) -> str:
    if not compared["poses"]:
        return str(compared["headline"])
    name, missing = compared["name"], compared["missing"]
    are = "pose is" if missing == 1 else "poses are"
    lost = f" {missing} {are} missing in {name}: failures in the tables." if missing else ""
    phrases = f"{compared['headline']}: {'; '.join(compared['changes'])}.{lost} {interval_words(compared)}"
    return f"{phrases} {compared['verdict']}".strip()


def interval_words(compared: Mapping[str, Any]) -> str:
    """The resampled units of the intervals, or the reason for none."""
    if compared["vss_mean"]["interval"] is None:
        return f"No intervals: {compared['resampled']} only, so this may be chance."
    return f"Intervals of 95 %, from resampling {compared['resampled']}."
