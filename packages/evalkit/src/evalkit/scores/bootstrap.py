"""95 % intervals by resampling poses recorded together: whole scenes, or images where there is one scene only.

Poses in the same scene have camera, light and objects in common, and in the same image even more: they are not
independent, and resampling single poses would give too narrow an interval. A resample draws as many units as there are,
with replacement, each with all its rows. The interval runs between two percentiles of the resampled scores. With few
units plain percentiles are too narrow, so they are shifted outwards as a t interval is wider than a normal one
("expanded percentile"). Fewer than two units have no interval.

Source: Efron and Tibshirani, "An Introduction to the Bootstrap", 1993, chapters 8 and 13; Hesterberg, "What Teachers
Should Know About the Bootstrap", The American Statistician 69(4), 2015, section 5.2.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import pandas as pd
from jaxtyping import Float, Int
from posecore.errors import ConfigError
from scipy import special

from evalkit.scores.per_pose import Values, score_values

Interval = tuple[float, float] | None
"""Lower and upper end, or None where there are fewer than two units."""
CONFIDENCE = 0.95
RESAMPLES = 1000
MAX_UNITS = 2000
"""More units than this are joined to blocks of neighbours: the interval stays as wide and memory small."""
FAN = 64
"""Number of parts of the range at each step of a median search."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Units:
    """Units of resampling: groups of rows drawn together.

    Attributes:
        kind: of each unit.
        text: number and kind in words, such as "13 scenes" or "50 blocks of 20 images".
        of_row: the unit of each row, counted from 0.
        count: number of units.
    """

    kind: Literal["scene", "image"]
    text: str
    of_row: Int[np.ndarray, " n"]
    count: int


def units_of(table: pd.DataFrame, block_images: int | None = None) -> Units:
    """Scenes, or images if there is a single scene, or blocks of consecutive images.

    Args:
        table: with `scene_id` and `im_id`.
        block_images: number of consecutive images of a scene in one unit, for video, where a pose depends on the
            previous frame. None for no blocks.

    Raises:
        ConfigError: `block_images` is below 1.
    """
    if block_images is not None and block_images < 1:
        raise ConfigError(f"block_images: found {block_images}, expected 1 or more")
    scene, image = table.scene_id.to_numpy(np.int64), table.im_id.to_numpy(np.int64)
    scenes, scene_of_row = np.unique(scene, return_inverse=True)
    if block_images is None and len(scenes) != 1:
        return _joined("scene", scene_of_row, len(scenes))
    images, image_of_row = np.unique(np.stack([scene, image], axis=1), axis=0, return_inverse=True)
    image_of_row = image_of_row.reshape(-1)
    if block_images is None:
        return _joined("image", image_of_row, len(images))
    first = np.searchsorted(images[:, 0], images[:, 0])  # index of the first image of each image's scene
    key = np.stack([images[:, 0], (np.arange(len(images)) - first) // block_images], axis=1)
    blocks, block_of_image = np.unique(key, axis=0, return_inverse=True)
    return Units(
        kind="image",
        text=_text("image", len(blocks), block_images),
        of_row=block_of_image.reshape(-1)[image_of_row].astype(np.int64),
        count=len(blocks),
    )


def _joined(kind: Literal["scene", "image"], of_row: Int[np.ndarray, " n"], count: int) -> Units:
    size = -(-count // MAX_UNITS) if count else 1
    joined = -(-count // size)
    return Units(kind=kind, text=_text(kind, joined, size), of_row=(of_row // size).astype(np.int64), count=joined)


def _text(kind: str, count: int, size: int) -> str:
    if size == 1:
        return f"{count} {kind}{'s' * (count != 1)}"
    return f"{count} block{'s' * (count != 1)} of {size} {kind}s"


@dataclass(frozen=True, kw_only=True, eq=False)
class Resampling:
    """Drawn units, the same for every score, so that scores and differences stay paired.

    Attributes:
        units: to draw.
        weights: (r, u) count of each unit in each resample.
    """

    units: Units
    weights: Float[np.ndarray, "r u"]

    def means(self, columns: Float[np.ndarray, "m n"]) -> Float[np.ndarray, "m r"]:
        """Mean of each column over the rows of each resample; NaN values are left out, NaN without any other."""
        is_valid = ~np.isnan(columns)
        sums = np.stack([self._per_unit(column) for column in np.where(is_valid, columns, 0.0)])
        counts = np.stack([self._per_unit(part.astype(np.float64)) for part in is_valid])
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.asarray((sums @ self.weights.T) / (counts @ self.weights.T))

    def medians(self, values: Float[np.ndarray, " n"]) -> Float[np.ndarray, " r"]:
        """Median of the rows of each resample, exactly; NaN values are left out, NaN without any other."""
        is_valid = np.flatnonzero(~np.isnan(values))
        order = is_valid[np.argsort(values[is_valid], kind="stable")]
        ordered, unit = values[order], self.units.of_row[order]
        total = self.weights @ np.bincount(unit, minlength=self.units.count)
        result = np.full(len(self.weights), np.nan)
        some = np.flatnonzero(total > 0)
        if len(some):
            low = _search(unit, self.weights[some], (total[some] - 1) // 2)
            high = _search(unit, self.weights[some], total[some] // 2)
            result[some] = (ordered[low] + ordered[high]) / 2.0
        return result

    def interval(self, values: Values) -> Interval:
        """Interval of a score."""
        return self.intervals({"": values})[""]

    def intervals(self, values: Mapping[str, Values]) -> dict[str, Interval]:
        """Interval of each score."""
        means = [name for name, item in values.items() if item.statistic == "mean"]
        sampled: dict[str, np.ndarray] = {}
        if means:
            columns = np.stack([values[name].per_row for name in means])
            sampled |= dict(zip(means, self.means(columns), strict=True))
        for name, item in values.items():
            if item.statistic == "median":
                sampled[name] = self.medians(item.per_row)
        return {name: self.ends(sampled[name], self.units_with(item.per_row)) for name, item in values.items()}

    def units_with(self, values: Float[np.ndarray, " n"]) -> int:
        """Number of units with a value that is not NaN."""
        return len(np.unique(self.units.of_row[~np.isnan(values)]))

    def ends(self, sampled: Float[np.ndarray, " r"], units: int) -> Interval:
        """Interval from resampled scores of so many units."""
        kept = sampled[~np.isnan(sampled)]
        if units < 2 or not len(kept) or not np.isfinite(kept).all():
            return None
        low, high = np.quantile(kept, outer_percentiles(units))
        return float(low), float(high)

    def _per_unit(self, values: Float[np.ndarray, " n"]) -> Float[np.ndarray, " u"]:
        sums = np.bincount(self.units.of_row, values, minlength=self.units.count)
        return sums.astype(np.float64)  # without rows numpy returns integers


def resample(units: Units, resamples: int = RESAMPLES, seed: int = 0) -> Resampling:
    """Draw resamples; they depend on the seed, their number and the number of units only.

    Raises:
        ConfigError: fewer than one resample, or a negative seed.
    """
    if resamples < 1 or seed < 0:
        raise ConfigError(f"bootstrap: found {resamples} resamples and seed {seed}, expected 1 or more, and 0 or more")
    rng = np.random.default_rng([seed, resamples, units.count])
    drawn = rng.integers(0, max(units.count, 1), size=(resamples, units.count))
    drawn += np.arange(resamples)[:, None] * units.count
    counts = np.bincount(drawn.reshape(-1), minlength=resamples * units.count)
    return Resampling(units=units, weights=counts.reshape(resamples, units.count).astype(np.float64))


def outer_percentiles(units: int, confidence: float = CONFIDENCE) -> tuple[float, float]:
    """Percentiles, as fractions, that cover `confidence` with so many units: a t interval's, rescaled to a normal.

    With 30 units they are 0.017 and 0.983 instead of 0.025 and 0.975.
    """
    tail = (1.0 - confidence) / 2.0
    stretched = np.sqrt(units / (units - 1.0)) * special.stdtrit(units - 1, tail)
    low = float(special.ndtr(stretched))
    return low, 1.0 - low


def _search(
    unit: Int[np.ndarray, " n"], weights: Float[np.ndarray, "r u"], rank: Float[np.ndarray, " r"]
) -> Int[np.ndarray, " r"]:
    """For each resample the first index at which the cumulative weight exceeds `rank`; `unit` is in order of value."""
    result = np.zeros(len(weights), np.int64)
    open_ranges: list[tuple[int, int, np.ndarray, np.ndarray]] = [
        (0, len(unit), np.arange(len(weights)), np.zeros(len(weights)))
    ]
    while open_ranges:
        start, stop, rows, before = open_ranges.pop()
        edges = np.linspace(start, stop, FAN + 1).astype(np.int64)
        if stop - start <= FAN:
            inside = weights[rows][:, unit[start:stop]]
        else:
            part = np.repeat(np.arange(FAN), np.diff(edges))
            counts = np.bincount(unit[start:stop] * FAN + part, minlength=weights.shape[1] * FAN)
            inside = weights[rows] @ counts.reshape(-1, FAN)
        reached = before[:, None] + np.cumsum(inside, axis=1)
        position = np.argmax(reached > rank[rows, None], axis=1)
        if stop - start <= FAN:
            result[rows] = start + position
            continue
        for which in np.unique(position):
            here = np.flatnonzero(position == which)
            passed = reached[here, which - 1] if which else before[here]
            open_ranges.append((int(edges[which]), int(edges[which + 1]), rows[here], passed))
    return result


@dataclass(frozen=True, kw_only=True, eq=False)
class ScoreIntervals:
    """Intervals of a table's scores.

    Attributes:
        kind: of the resampled units, "scene" or "image".
        text: number and kind in words.
        units: number of units.
        resamples: number of resamples.
        seed: of the draws.
        confidence: probability that the interval holds the expected score.
        intervals: by the score's key.
    """

    kind: str
    text: str
    units: int
    resamples: int
    seed: int
    confidence: float
    intervals: dict[str, Interval]

    def as_json(self) -> dict[str, Any]:
        """Plain data."""
        ends = {name: None if ends is None else list(ends) for name, ends in self.intervals.items()}
        return {
            "resampled": self.text,
            "unit": self.kind,
            "units": self.units,
            "resamples": self.resamples,
            "seed": self.seed,
            "confidence": self.confidence,
            "intervals": ends,
        }


def score_intervals(
    table: pd.DataFrame,
    *,
    names: Sequence[str] | None = None,
    resamples: int = RESAMPLES,
    seed: int = 0,
    block_images: int | None = None,
) -> ScoreIntervals:
    """Intervals of the scores that `scores.scores` gives for a table.

    Args:
        table: see `evalkit.error_table`.
        names: keys of the scores; all by default.
        resamples: number of resamples.
        seed: of the draws.
        block_images: see `units_of`.
    """
    resampling = resample(units_of(table, block_images), resamples, seed)
    values = score_values(table)
    chosen = values if names is None else {name: values[name] for name in names}
    return ScoreIntervals(
        kind=resampling.units.kind,
        text=resampling.units.text,
        units=resampling.units.count,
        resamples=resamples,
        seed=seed,
        confidence=CONFIDENCE,
        intervals=resampling.intervals(chosen),
    )
