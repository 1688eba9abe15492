"""BOP's matching of estimates to ground-truth instances, BOP19's average recalls and BOP24's average precision.

Estimates of an object in an image are taken in order of score, equal ones in the file's order. Each takes the free
instance with the smallest error under the threshold. Every error and every threshold has a matching of its own, so one
estimate may be matched to different instances at different thresholds.

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

IMAGE = ["scene_id", "im_id"]
TARGET = ["scene_id", "im_id", "obj_id"]


@dataclass(frozen=True, kw_only=True, eq=False)
class AllErrors:
    """Every estimate of a result file against every instance of its object in its image, for the targets' images.

    Attributes:
        estimates: `scene_id`, `im_id`, `obj_id`, `line` (in the file), `score`: one row for each estimate, also of
            objects that the image does not contain.
        instances: `scene_id`, `im_id`, `obj_id`, `gt_index`, `visib_fract` (NaN where unknown), `inst_count` (number
            of this object in the image's target, 0 without one), `diameter_m`, `image_width_px`: one
            row for each annotated instance with a pose, also those that are not targets.
        errors: `estimate` and `instance` (positions in the two tables), `mssd_m`, `mspd_px` and, where there is depth,
            `vsd_0.05` ... `vsd_0.50`: one row for each estimate and each instance of its object in its image.
    """

    estimates: pd.DataFrame
    instances: pd.DataFrame
    errors: pd.DataFrame


def greedy_matches(
    estimate: Int[np.ndarray, " c"],
    instance: Int[np.ndarray, " c"],
    error: Float[np.ndarray, " c"],
    rank: Int[np.ndarray, " e"],
    instances: int,
    limits: Float[np.ndarray, " t"],
) -> Int[np.ndarray, "t e"]:
    """Match estimates to instances for every threshold at once.

    Args:
        estimate: of each pair, the estimate's position.
        instance: of each pair, the instance's position.
        error: of each pair, in the limits' unit; NaN and infinity match nothing.
        rank: of each estimate in its image and object by score, 0 for the best; estimates of the same instance have
            different ranks.
        instances: number of instances.
        limits: thresholds; an error at a threshold is not under it.

    Returns:
        For each threshold and estimate the position of its instance, -1 without one.
    """
    matched = np.full((len(limits), len(rank)), -1, np.int64)
    if not len(error):
        return matched
    order = np.lexsort((instance, estimate, rank[estimate]))
    estimate, instance, error = estimate[order], instance[order], error[order]
    under = np.where(error < limits[:, None], error, np.inf)
    free = np.ones((len(limits), instances), bool)
    rounds = np.flatnonzero(np.diff(rank[estimate], prepend=-1))
    for start, stop in zip(rounds, [*rounds[1:], len(error)], strict=True):
        part = slice(start, stop)
        open_errors = np.where(free[:, instance[part]], under[:, part], np.inf)
        firsts = np.flatnonzero(np.diff(estimate[part], prepend=-1))
        sizes = np.diff([*firsts, stop - start])
        best = np.minimum.reduceat(open_errors, firsts, axis=1)
        is_best = (open_errors == np.repeat(best, sizes, axis=1)) & np.isfinite(open_errors)
        positions = np.where(is_best, np.arange(stop - start), stop - start)
        chosen = np.minimum.reduceat(positions, firsts, axis=1)  # the first of equally good ones
        level, which = np.nonzero(np.isfinite(best))
        taken = instance[part][chosen[level, which]]
        matched[level, estimate[part][firsts][which]] = taken
        free[level, taken] = False
    return matched


def ranks(estimates: pd.DataFrame, among: list[str]) -> Int[np.ndarray, " e"]:
    """Rank of each estimate by falling score among those with the same ids; equal scores keep the table's order."""
    order = np.argsort(-column(estimates, "score"), kind="stable")
    positions = estimates.iloc[order].groupby(among, sort=False).cumcount().to_numpy()
    result = np.empty(len(estimates), np.int64)
    result[order] = positions
    return result


def target_instances(instances: pd.DataFrame) -> Bool[np.ndarray, " g"]:
    """Whether an instance is part of its localization target: the `inst_count` most visible, ties in image order."""
    visible = np.nan_to_num(column(instances, "visib_fract"), nan=1.0)
    order = np.lexsort((instances.gt_index.to_numpy(), -visible))
    positions = instances.iloc[order].groupby(TARGET, sort=False).cumcount().to_numpy()
    rank_in_image = np.empty(len(instances), np.int64)
    rank_in_image[order] = positions
    return np.asarray(rank_in_image < instances.inst_count.to_numpy())


def bop19_recalls(all_errors: AllErrors) -> pd.DataFrame:
    """For each target instance the fraction of thresholds at which BOP19's matching assigns it an estimate.

    The mean of a column is BOP's average recall of that error, over any set of rows.

    Returns:
        `scene_id`, `im_id`, `obj_id`, `gt_index`, `bop19_mssd`, `bop19_mspd` and, where there is VSD, `bop19_vsd`.
    """
    instances, errors = all_errors.instances, all_errors.errors
    is_target = target_instances(instances)
    rank = ranks(all_errors.estimates, TARGET)
    estimate, instance = _positions(errors, "estimate"), _positions(errors, "instance")
    kept = is_target[instance] & (rank[estimate] < instances.inst_count.to_numpy()[instance])
    estimate, instance, errors = estimate[kept], instance[kept], errors[kept]

    def recall(error: Float[np.ndarray, " c"], limits: Float[np.ndarray, " t"]) -> Float[np.ndarray, " g"]:
        matched = greedy_matches(estimate, instance, error, rank, len(instances), limits)
        hits = np.bincount(matched[matched >= 0], minlength=len(instances))
        return np.asarray(hits / len(limits))

    result = instances[[*TARGET, "gt_index"]].copy()
    mssd_diameters, mspd_scaled_px = _scaled(errors, instances, instance)
    result["bop19_mssd"] = recall(mssd_diameters, MSSD_DIAMETERS)
    result["bop19_mspd"] = recall(mspd_scaled_px, MSPD_PX)
    if all(name in errors for name in VSD_COLUMNS):
        result["bop19_vsd"] = np.mean([recall(column(errors, name), VSD_LIMITS) for name in VSD_COLUMNS], axis=0)
    return result[is_target].reset_index(drop=True)


def with_bop19(table: pd.DataFrame, all_errors: AllErrors) -> pd.DataFrame:
    """The table of errors with BOP19's recalls for each expected pose, so that averages follow BOP's matching.

    Args:
        table: one row for each target instance.
        all_errors: of the same result file and targets.
    """
    recalls = bop19_recalls(all_errors).drop(columns="obj_id")
    return table.merge(recalls, how="left", on=["scene_id", "im_id", "gt_index"], validate="many_to_one")


def bop24_precision(
    all_errors: AllErrors,
    *,
    visible: float = BOP24_VISIBLE,
    per_image: int = BOP24_ESTIMATES,
    count_absent: bool = False,
) -> dict[str, Any]:
    """BOP24's average precision of 6D detection: all estimates and all instances of the targets' images.

    Instances that are hardly visible need no estimate, and estimates matched to such an instance are left out. Objects
    without a visible instance are left out of the means. As in bop_toolkit, estimates of an object that the image does
    not contain are left out too, although they are false positives.

    Args:
        all_errors: see `AllErrors`.
        visible: smallest visible fraction of an instance that needs an estimate; an unknown fraction is visible.
        per_image: number of estimates counted in an image, those with the highest scores. BOP has 200 for XYZ-IBD.
        count_absent: count estimates of absent objects as false positives instead.

    Returns:
        `ap` (mean of the next two), `ap_mssd`, `ap_mspd`, `ap_mssd_mm` (BOP25's, 2 to 20 mm), `by_object` (the same
        for each), `estimates` and `instances` (numbers counted), `outscored` and `absent` (numbers of estimates left
        out for their rank and for their object). NaN where there is no instance.
    """
    instances, estimates = all_errors.instances, all_errors.estimates
    is_kept = ranks(estimates, IMAGE) < per_image
    is_visible = np.nan_to_num(column(instances, "visib_fract"), nan=1.0) >= visible
    annotated = pd.MultiIndex.from_frame(instances[TARGET])
    is_present = pd.MultiIndex.from_frame(estimates[TARGET]).isin(annotated)
    is_counted = is_kept if count_absent else is_kept & is_present
    rank = ranks(estimates, TARGET)
    estimate, instance = _positions(all_errors.errors, "estimate"), _positions(all_errors.errors, "instance")
    kept = is_kept[estimate]
    estimate, instance, errors = estimate[kept], instance[kept], all_errors.errors[kept]
    mssd_diameters, mspd_scaled_px = _scaled(errors, instances, instance)
    kinds = {
        "ap_mssd": (mssd_diameters, MSSD_DIAMETERS),
        "ap_mspd": (mspd_scaled_px, MSPD_PX),
        "ap_mssd_mm": (column(errors, "mssd_m") * 1e3, MSSD_MM),
    }
    precision = _precision_of(estimates, instances, is_counted, is_visible)
    by_object: dict[int, dict[str, float]] = {
        int(obj_id): {} for obj_id in np.unique(instances.obj_id.to_numpy()[is_visible]).tolist()
    }
    for name, (error, limits) in kinds.items():
        matched = greedy_matches(estimate, instance, error, rank, len(instances), limits)
        for obj_id, values in by_object.items():
            values[name] = precision(obj_id, matched)
    return _with_means(by_object) | {
        "by_object": by_object,
        "estimates": int(is_counted.sum()),
        "instances": int(is_visible.sum()),
        "outscored": int((~is_kept).sum()),
        "absent": int((is_kept & ~is_present).sum()),
    }


def _with_means(by_object: dict[int, dict[str, float]]) -> dict[str, Any]:
    """Means over objects of every precision; adds `ap` to each object."""
    for values in by_object.values():
        values["ap"] = (values["ap_mssd"] + values["ap_mspd"]) / 2.0
    return {
        name: float(np.mean([values[name] for values in by_object.values()])) if by_object else float("nan")
        for name in ("ap", "ap_mssd", "ap_mspd", "ap_mssd_mm")
    }


def _precision_of(
    estimates: pd.DataFrame,
    instances: pd.DataFrame,
    is_counted: Bool[np.ndarray, " e"],
    is_visible: Bool[np.ndarray, " g"],
) -> Callable[[int, Int[np.ndarray, "t e"]], float]:
    """A function of an object and its matches at every threshold: the mean of its average precisions."""
    # bop_toolkit goes through images in the targets' order and keeps it among equal scores.
    order = np.lexsort((ranks(estimates, TARGET), estimates.im_id, estimates.scene_id))
    order = order[np.argsort(-column(estimates, "score")[order], kind="stable")]
    order = order[is_counted[order]]
    obj_ids = estimates.obj_id.to_numpy()
    is_visible_or_none = np.append(is_visible, False)  # position -1: no match

    def precision(obj_id: int, matched: Int[np.ndarray, "t e"]) -> float:
        of_object = order[obj_ids[order] == obj_id]
        count = int((is_visible & (instances.obj_id.to_numpy() == obj_id)).sum())
        values = []
        for match in matched[:, of_object]:
            is_true = is_visible_or_none[match]
            values.append(average_precision(is_true[is_true | (match < 0)], count))
        return float(np.mean(values))

    return precision


def average_precision(is_true: Bool[np.ndarray, " n"], instances: int) -> float:
    """Mean of the best precision at or beyond each of COCO's 101 levels of recall.

    Args:
        is_true: whether each estimate, by falling score, is a true positive.
        instances: number of instances, at least 1.
    """
    if not len(is_true):
        return 0.0
    hits = np.cumsum(is_true)
    recall = hits / float(instances)
    precision = hits / np.arange(1, len(is_true) + 1)
    best = np.append(np.maximum.accumulate(precision[::-1])[::-1], 0.0)
    return float(np.mean(best[np.searchsorted(recall, RECALL_LEVELS, side="left")]))


def _scaled(
    errors: pd.DataFrame, instances: pd.DataFrame, instance: Int[np.ndarray, " c"]
) -> tuple[Float[np.ndarray, " c"], Float[np.ndarray, " c"]]:
    """MSSD in diameters, and MSPD in pixels of an image 640 wide."""
    factor = MSPD_WIDTH_PX / column(instances, "image_width_px")[instance]
    mssd_diameters = in_diameters(column(errors, "mssd_m"), column(instances, "diameter_m")[instance])
    return mssd_diameters, column(errors, "mspd_px") * factor


def _positions(errors: pd.DataFrame, name: str) -> Int[np.ndarray, " c"]:
    return np.asarray(errors[name].to_numpy(), dtype=np.int64)
