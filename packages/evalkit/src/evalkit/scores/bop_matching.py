"""BOP's own matching of estimates to true instances, BOP19's average recalls and BOP24's average precision.

Estimates of an object in an image are taken in order of score, equal ones in the file's order. Each takes the true
instance with the smallest error under the threshold of those that are still free. This is done anew for every error
and every threshold, so that one estimate may belong to different instances at different thresholds.

Sources: Hodan et al., "BOP Challenge 2020", ECCVW 2020 (localization); "BOP Challenge 2024" (detection); and, where
these leave a choice, bop_toolkit's pose_matching.py, score.py and eval_bop24_pose.py.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Bool, Float, Int

from evalkit.error_table import column
from evalkit.pose_errors.metrics import VSD_COLUMNS
from evalkit.scores.definitions import (
    BOP24_ESTIMATES,
    BOP24_VISIBLE,
    MSPD_PX,
    MSPD_WIDTH_PX,
    MSSD_DIAMETERS,
    MSSD_MM,
    RECALL_LEVELS,
    VSD_LIMITS,
)
from evalkit.scores.per_pose import in_diameters

Array = np.ndarray
IMAGE = ["scene_id", "im_id"]
TARGET = ["scene_id", "im_id", "obj_id"]


@dataclass(frozen=True, kw_only=True, eq=False)
class AllErrors:
    """Every estimate of a result file against every true instance of its object in its image.

    Only images that the targets name take part.

    Attributes:
        estimates: `scene_id`, `im_id`, `obj_id`, `line` (in the file), `score`: one row for each estimate, also of
            objects that the image does not hold.
        truths: `scene_id`, `im_id`, `obj_id`, `gt_index`, `visib_fract` (NaN where unknown), `inst_count` (how many
            of this object the targets ask for in the image, 0 where they do not), `diameter_m`, `image_width_px`: one
            row for each annotated instance with a pose, also those that are no target.
        errors: `estimate` and `truth` (positions in the two tables), `mssd_m`, `mspd_px` and, where there is depth,
            `vsd_0.05` ... `vsd_0.50`: one row for each estimate and each true instance of its object in its image.
    """

    estimates: pd.DataFrame
    truths: pd.DataFrame
    errors: pd.DataFrame


def greedy_matches(
    estimate: Int[Array, " c"],
    truth: Int[Array, " c"],
    error: Float[Array, " c"],
    rank: Int[Array, " e"],
    truths: int,
    limits: Float[Array, " t"],
) -> Int[Array, "t e"]:
    """Match estimates to true instances for every threshold at once.

    Args:
        estimate: of each pair, the estimate's position.
        truth: of each pair, the true instance's position.
        error: of each pair, in the limits' unit; NaN and infinity match nothing.
        rank: place of each estimate in its image and object by score, 0 for the best; estimates that share a true
            instance have different ranks.
        truths: number of true instances.
        limits: an error has to be under it.

    Returns:
        For each threshold and estimate the position of its true instance, -1 where it has none.
    """
    matched = np.full((len(limits), len(rank)), -1, np.int64)
    if not len(error):
        return matched
    order = np.lexsort((truth, estimate, rank[estimate]))
    estimate, truth, error = estimate[order], truth[order], error[order]
    under = np.where(error < limits[:, None], error, np.inf)
    free = np.ones((len(limits), truths), bool)
    rounds = np.flatnonzero(np.diff(rank[estimate], prepend=-1))
    for start, stop in zip(rounds, [*rounds[1:], len(error)], strict=True):
        part = slice(start, stop)
        open_errors = np.where(free[:, truth[part]], under[:, part], np.inf)
        firsts = np.flatnonzero(np.diff(estimate[part], prepend=-1))
        sizes = np.diff([*firsts, stop - start])
        best = np.minimum.reduceat(open_errors, firsts, axis=1)
        is_best = (open_errors == np.repeat(best, sizes, axis=1)) & np.isfinite(open_errors)
        places = np.where(is_best, np.arange(stop - start), stop - start)
        chosen = np.minimum.reduceat(places, firsts, axis=1)  # the first of equally good ones
        level, which = np.nonzero(np.isfinite(best))
        taken = truth[part][chosen[level, which]]
        matched[level, estimate[part][firsts][which]] = taken
        free[level, taken] = False
    return matched


def ranks(estimates: pd.DataFrame, among: list[str]) -> Int[Array, " e"]:
    """Place of each estimate by falling score among those with the same ids; equal scores keep the table's order."""
    order = np.argsort(-column(estimates, "score"), kind="stable")
    places = estimates.iloc[order].groupby(among, sort=False).cumcount().to_numpy()
    result = np.empty(len(estimates), np.int64)
    result[order] = places
    return result


def target_truths(truths: pd.DataFrame) -> Bool[Array, " g"]:
    """Which instances a localization target means: the `inst_count` most visible; equal ones in the image's order."""
    visible = np.nan_to_num(column(truths, "visib_fract"), nan=1.0)
    order = np.lexsort((truths.gt_index.to_numpy(), -visible))
    places = truths.iloc[order].groupby(TARGET, sort=False).cumcount().to_numpy()
    place = np.empty(len(truths), np.int64)
    place[order] = places
    return np.asarray(place < truths.inst_count.to_numpy())


def bop19_shares(everything: AllErrors) -> pd.DataFrame:
    """For each target instance the share of thresholds at which BOP19's matching gives it an estimate.

    The mean of a column is BOP's average recall of that error, over any set of rows.

    Returns:
        `scene_id`, `im_id`, `obj_id`, `gt_index`, `bop19_mssd`, `bop19_mspd` and, where there is VSD, `bop19_vsd`.
    """
    truths, errors = everything.truths, everything.errors
    wanted = target_truths(truths)
    rank = ranks(everything.estimates, TARGET)
    estimate, truth = _positions(errors, "estimate"), _positions(errors, "truth")
    kept = wanted[truth] & (rank[estimate] < truths.inst_count.to_numpy()[truth])
    estimate, truth, errors = estimate[kept], truth[kept], errors[kept]

    def share(error: Float[Array, " c"], limits: Float[Array, " t"]) -> Float[Array, " g"]:
        matched = greedy_matches(estimate, truth, error, rank, len(truths), limits)
        hits = np.bincount(matched[matched >= 0], minlength=len(truths))
        return np.asarray(hits / len(limits))

    result = truths[[*TARGET, "gt_index"]].copy()
    mssd_diameters, mspd_scaled_px = _scaled(errors, truths, truth)
    result["bop19_mssd"] = share(mssd_diameters, MSSD_DIAMETERS)
    result["bop19_mspd"] = share(mspd_scaled_px, MSPD_PX)
    if all(name in errors for name in VSD_COLUMNS):
        result["bop19_vsd"] = np.mean([share(column(errors, name), VSD_LIMITS) for name in VSD_COLUMNS], axis=0)
    return result[wanted].reset_index(drop=True)


def with_bop19(table: pd.DataFrame, everything: AllErrors) -> pd.DataFrame:
    """The table of errors with BOP19's shares beside each expected pose, so that averages follow BOP's matching.

    Args:
        table: one row for each target instance.
        everything: of the same result file and targets.
    """
    shares = bop19_shares(everything).drop(columns="obj_id")
    return table.merge(shares, how="left", on=["scene_id", "im_id", "gt_index"], validate="many_to_one")


def bop24_precision(
    everything: AllErrors,
    *,
    visible: float = BOP24_VISIBLE,
    per_image: int = BOP24_ESTIMATES,
    count_absent: bool = False,
) -> dict[str, Any]:
    """BOP24's average precision of 6D detection: all estimates and all true instances of the targets' images.

    Estimates matched to an instance that is hardly visible are left out, and such instances ask for nothing. Objects
    without a visible instance have no part in the means. As in bop_toolkit, estimates of an object that the image
    does not hold are left out too, although they are false alarms.

    Args:
        everything: see `AllErrors`.
        visible: smallest visible share of an instance that has to be found; an unknown share counts as visible.
        per_image: number of estimates of an image that count, those with the highest scores. BOP takes 200 for
            XYZ-IBD.
        count_absent: count estimates of absent objects as false alarms instead.

    Returns:
        `ap` (mean of the next two), `ap_mssd`, `ap_mspd`, `ap_mssd_mm` (BOP25's, 2 to 20 mm), `by_object` (the same
        for each), `estimates` and `instances` (how many counted), `outscored` and `absent` (how many estimates were
        left out for their rank and for their object). NaN where there is no instance.
    """
    truths, estimates = everything.truths, everything.estimates
    in_time = ranks(estimates, IMAGE) < per_image
    asked = np.nan_to_num(column(truths, "visib_fract"), nan=1.0) >= visible
    held = pd.MultiIndex.from_frame(truths[TARGET])
    present = pd.MultiIndex.from_frame(estimates[TARGET]).isin(held)
    counted = in_time if count_absent else in_time & present
    rank = ranks(estimates, TARGET)
    estimate, truth = _positions(everything.errors, "estimate"), _positions(everything.errors, "truth")
    kept = in_time[estimate]
    estimate, truth, errors = estimate[kept], truth[kept], everything.errors[kept]
    mssd_diameters, mspd_scaled_px = _scaled(errors, truths, truth)
    kinds = {
        "ap_mssd": (mssd_diameters, MSSD_DIAMETERS),
        "ap_mspd": (mspd_scaled_px, MSPD_PX),
        "ap_mssd_mm": (column(errors, "mssd_m") * 1e3, MSSD_MM),
    }
    by_object: dict[int, dict[str, float]] = {
        int(obj_id): {} for obj_id in np.unique(truths.obj_id.to_numpy()[asked]).tolist()
    }
    precision = _precision_of(estimates, truths, counted, asked)
    for name, (error, limits) in kinds.items():
        matched = greedy_matches(estimate, truth, error, rank, len(truths), limits)
        for obj_id, values in by_object.items():
            values[name] = precision(obj_id, matched)
    for values in by_object.values():
        values["ap"] = (values["ap_mssd"] + values["ap_mspd"]) / 2.0
    totals = {
        name: float(np.mean([values[name] for values in by_object.values()])) if by_object else float("nan")
        for name in ("ap", *kinds)
    }
    return totals | {
        "by_object": by_object,
        "estimates": int(counted.sum()),
        "instances": int(asked.sum()),
        "outscored": int((~in_time).sum()),
        "absent": int((in_time & ~present).sum()),
    }


def _precision_of(
    estimates: pd.DataFrame, truths: pd.DataFrame, counted: Bool[Array, " e"], asked: Bool[Array, " g"]
) -> Callable[[int, Int[Array, "t e"]], float]:
    """A function of an object and its matches at every threshold: the mean of its average precisions."""
    # bop_toolkit goes through images in the targets' order and keeps it among equal scores.
    order = np.lexsort((ranks(estimates, TARGET), estimates.im_id, estimates.scene_id))
    order = order[np.argsort(-column(estimates, "score")[order], kind="stable")]
    order = order[counted[order]]
    obj_ids = estimates.obj_id.to_numpy()
    asked_or_none = np.append(asked, False)  # position -1: no match

    def precision(obj_id: int, matched: Int[Array, "t e"]) -> float:
        own = order[obj_ids[order] == obj_id]
        instances = int((asked & (truths.obj_id.to_numpy() == obj_id)).sum())
        values = []
        for match in matched[:, own]:
            is_true = asked_or_none[match]
            values.append(average_precision(is_true[is_true | (match < 0)], instances))
        return float(np.mean(values))

    return precision


def average_precision(is_true: Bool[Array, " n"], instances: int) -> float:
    """Mean of the best precision at or beyond each of COCO's 101 levels of recall.

    Args:
        is_true: whether each estimate, by falling score, is a true one.
        instances: how many there were to find, at least 1.
    """
    if not len(is_true):
        return 0.0
    hits = np.cumsum(is_true)
    recall = hits / float(instances)
    precision = hits / np.arange(1, len(is_true) + 1)
    best = np.append(np.maximum.accumulate(precision[::-1])[::-1], 0.0)
    return float(np.mean(best[np.searchsorted(recall, RECALL_LEVELS, side="left")]))


def _scaled(
    errors: pd.DataFrame, truths: pd.DataFrame, truth: Int[Array, " c"]
) -> tuple[Float[Array, " c"], Float[Array, " c"]]:
    """MSSD in diameters, and MSPD in pixels of an image 640 wide."""
    factor = MSPD_WIDTH_PX / column(truths, "image_width_px")[truth]
    mssd_diameters = in_diameters(column(errors, "mssd_m"), column(truths, "diameter_m")[truth])
    return mssd_diameters, column(errors, "mspd_px") * factor


def _positions(errors: pd.DataFrame, name: str) -> Int[Array, " c"]:
    return np.asarray(errors[name].to_numpy(), dtype=np.int64)
