"""What changed between two result files, pose by pose: numbers with intervals, and the same in words."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from evalkit.error_table import column
from evalkit.evaluation.scored_file import Scored
from evalkit.scores import found_errors
from evalkit.scores.bootstrap import Interval, Resampling, resample, units_of
from evalkit.scores.per_pose import solved

Array = np.ndarray
Change = dict[str, Any]
COMPARED: Mapping[str, str] = {
    "re_sym_deg": "rotation error",
    "tx_mm": "x error",
    "ty_mm": "y error",
    "tz_mm": "z error",
    "add_mm": "ADD",
}
"""Errors whose medians are compared, and what they are called."""
SHARES: Mapping[str, str] = {"vss_mean": "mean VSS", "add_s_recall": "ADD(-S) recall at 0.1 diameter"}
"""Scores whose means are compared."""
NO_ERROR = 1e-4
"""Degrees and millimetres: a result file's nine decimals lie below."""
MINUS = "\N{MINUS SIGN}"


def compare(reference: Scored, other: Scored, *, resamples: int = 1000, seed: int = 0) -> dict[str, Any]:
    """Medians, mean VSS and recall of two files over the same poses, the changes with 95 % intervals, and in words.

    Intervals are of the paired change: both files' poses of a scene (or image, see `evalkit.scores.bootstrap`) are
    drawn together.

    Args:
        reference: start poses, or the file that the other is compared with.
        other: the file that is spoken of.
        resamples: of the bootstrap.
        seed: of the bootstrap.

    Returns:
        `name`, `start` (name of the reference), `is_start`, `poses` (found in both), `missing` (in the other file),
        `medians` by error with `poses`, `start`, `refined`, `ratio`, `difference`, `interval`; `vss_mean` and
        `add_s_recall` with the same but for the ratio; `resampled` (units in words); `headline`, `verdict` (what
        got better, worse, or did not change significantly; empty without intervals), `changes`, a phrase for each
        number, and `words`, all of it in one text. Values without data are NaN.
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
        "start": reference.file.name,
        "is_start": reference.file.is_start,
        "poses": len(after),
        "missing": int((~other.table.found).sum()),
        "medians": {name: _medians(old[name], new[name], drawn) for name in COMPARED},
        "vss_mean": _means(column(before, "vss"), column(after, "vss"), drawn),
        "add_s_recall": _means(_shares(solved(all_before)), _shares(solved(all_after)), all_drawn),
        "resampled": drawn.units.text,
    }
    compared["headline"] = _headline(compared)
    compared["verdict"] = _verdict(compared)
    compared["changes"] = _changes(compared) if len(after) else []
    compared["words"] = _words(compared)
    return compared


def _shares(flags: Bool[Array, " n"]) -> Float[Array, " n"]:
    return flags.astype(np.float64)


def _medians(old: Float[Array, " n"], new: Float[Array, " n"], drawn: Resampling) -> Change:
    """Medians over the poses whose start has an error of this kind: curves also hold starts that are only moved."""
    off = old > NO_ERROR
    if not off.any():
        nothing = float("nan")
        return {"poses": 0, "start": nothing, "refined": nothing, "ratio": nothing, "difference": nothing} | {
            "interval": None
        }
    old, new = np.where(off, old, np.nan), np.where(off, new, np.nan)
    start, refined = float(np.nanmedian(old)), float(np.nanmedian(new))
    interval = drawn.ends(drawn.medians(new) - drawn.medians(old), drawn.units_with(old))
    counts = {"poses": int(off.sum()), "start": start, "refined": refined, "ratio": refined / start}
    return counts | {"difference": refined - start, "interval": interval}


def _means(old: Float[Array, " n"], new: Float[Array, " n"], drawn: Resampling) -> Change:
    if not len(old):
        nothing = float("nan")
        return {"start": nothing, "refined": nothing, "difference": nothing, "interval": None}
    start, refined = float(old.mean()), float(new.mean())
    interval = drawn.ends(drawn.means((new - old)[None])[0], drawn.units.count)
    return {"start": start, "refined": refined, "difference": refined - start, "interval": interval}


def _headline(compared: Change) -> str:
    name, reference, count = compared["name"], compared["start"], compared["poses"]
    if not count:
        return f"{name} and {reference} have no pose in common."
    against = f"its start poses ({reference})" if compared["is_start"] else reference
    poses = "the pose" if count == 1 else f"the {count} poses"
    return f"{name} against {against}, medians over {poses} found in both"


def _verdict(compared: Change) -> str:
    """Which numbers are better, worse or neither, by their intervals."""
    found: dict[str, list[str]] = {"better": [], "worse": [], "no significant change": []}
    errors = [(label, compared["medians"][key]["interval"], -1) for key, label in COMPARED.items()]
    scores = [(label, compared[key]["interval"], 1) for key, label in SHARES.items()]
    for label, interval, sign in (*errors, *scores):
        if interval is not None:
            better = (interval[0] > 0.0) if sign > 0 else (interval[1] < 0.0)
            found["no significant change" if holds_zero(interval) else "better" if better else "worse"].append(label)
    parts = [f"{name}: {', '.join(labels)}." for name, labels in found.items() if labels]
    return " ".join(part[0].upper() + part[1:] for part in parts)


def _changes(compared: Change) -> list[str]:
    whose = "the start's" if compared["is_start"] else f"that of {compared['start']}"
    said = []
    for key, label in COMPARED.items():
        values = compared["medians"][key]
        if not values["poses"]:
            continue
        unit = "°" if key.endswith("_deg") else " mm"
        few = f", {values['poses']} starts" if values["poses"] < compared["poses"] else ""
        numbers = f"{values['start']:.3g}{unit} to {values['refined']:.3g}{unit}{few}{_difference(values, unit)}"
        said.append(f"{label} {_relative(values, whose)} ({numbers})")
    for key, factor, unit, style in (("vss_mean", 1.0, "", ".3f"), ("add_s_recall", 100.0, " %", ".1f")):
        values = compared[key]
        start, refined = (format(factor * values[side], style) for side in ("start", "refined"))
        change = _difference(values, unit and " points", factor, style)
        verdict = "no significant change, " if holds_zero(values["interval"]) else ""
        said.append(f"{SHARES[key]} {verdict}{start}{unit} to {refined}{unit}{change}")
    return said


def _relative(values: Change, whose: str) -> str:
    if holds_zero(values["interval"]):
        return "no significant change"
    ratio = values["ratio"]
    if values["interval"] is None and abs(ratio - 1.0) < 0.02:
        return f"about the same, {ratio:.2f} of {whose}"
    return f"{'down to' if ratio < 1 else 'up to'} {ratio:.2f} of {whose}"


def holds_zero(interval: Interval) -> bool:
    """Whether a change may be none at all. Without an interval nothing is said."""
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
    """A number with its sign, which zero has not."""
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
    said = f"{compared['headline']}: {'; '.join(compared['changes'])}.{lost} {interval_words(compared)}"
    return f"{said} {compared['verdict']}".strip()


def interval_words(compared: Mapping[str, Any]) -> str:
    """What the intervals were drawn from, or why there are none."""
    if compared["vss_mean"]["interval"] is None:
        return f"No intervals: {compared['resampled']} only, so this may be chance."
    return f"Intervals of 95 %, from resampling {compared['resampled']}."
