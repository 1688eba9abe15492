"""What is compared with what: every expected pose with its estimate, or with none."""

from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from posecore.bop import BopDataset, BopTarget, Estimate, GroundTruth
from posecore.errors import DatasetError, ResultFileError

from evalkit.inputs.result_files import ResultFile

Key = tuple[int, int, int]


@dataclass(frozen=True, kw_only=True)
class Level:
    """How far a start pose was moved from the truth."""

    angle_deg: float
    translation_diameter: float


@dataclass(frozen=True, kw_only=True, eq=False)
class Pair:
    """One expected pose: the truth, the estimate or None, and the level of a start perturbed by steps."""

    scene_id: int
    im_id: int
    truth: GroundTruth
    estimate: Estimate | None
    level: Level | None = None


@dataclass(frozen=True, kw_only=True)
class Pairing:
    """All pairs of one result file, and how many of its lines belong to no expected pose."""

    pairs: list[Pair]
    ignored: int


def truths_of(dataset: BopDataset, target: BopTarget) -> list[GroundTruth]:
    """Annotated instances of a target with a pose, the most visible first.

    Raises:
        DatasetError: there is none.
    """
    found = [gt for gt in dataset.gt(target.scene_id, target.im_id) if gt.obj_id == target.obj_id and gt.has_pose]
    if not found:
        scene = dataset.scene_path(target.scene_id)
        raise DatasetError(
            f"{scene / 'scene_gt.json'}: image {target.im_id} has no pose of object {target.obj_id}, "
            "which the targets ask for"
        )
    return sorted(found, key=lambda gt: -(1.0 if gt.visib_fract is None else gt.visib_fract))


def pair_up(dataset: BopDataset, result: ResultFile) -> Pairing:
    """Pair a result file with ground truth: by start where the file says how poses were perturbed, else by target."""
    perturbation = result.sidecar.get("perturbation")
    if perturbation is None:
        return _pair_targets(dataset, result)
    return _pair_starts(dataset, result, _planned(perturbation, result))


def _pair_targets(dataset: BopDataset, result: ResultFile) -> Pairing:
    """For every target its `inst_count` best-scored estimates; each takes the nearest truth that is still free."""
    by_key = _by_key(result.estimates)
    pairs: list[Pair] = []
    for target in dataset.targets:
        truths = truths_of(dataset, target)[: target.inst_count]  # BOP means the most visible ones
        candidates = by_key.get((target.scene_id, target.im_id, target.obj_id), [])
        best = sorted(candidates, key=lambda estimate: -estimate.score)[: target.inst_count]
        matched: list[tuple[GroundTruth, Estimate | None]] = []
        for estimate in best[: len(truths)]:
            free = [gt for gt in truths if all(gt is not other for other, _ in matched)]
            matched.append((min(free, key=lambda gt: _distance_m(estimate, gt)), estimate))
        left = [gt for gt in truths if all(gt is not other for other, _ in matched)]
        matched += [(gt, None) for gt in left[: max(0, min(target.inst_count, len(truths)) - len(matched))]]
        pairs += [
            Pair(scene_id=target.scene_id, im_id=target.im_id, truth=gt, estimate=estimate) for gt, estimate in matched
        ]
    used = sum(pair.estimate is not None for pair in pairs)
    return Pairing(pairs=pairs, ignored=len(result.estimates) - used)


def _distance_m(estimate: Estimate, truth: GroundTruth) -> float:
    return float(np.linalg.norm(estimate.T_cam_obj[:3, 3] - truth.T_cam_obj[:3, 3]))


def _by_key(estimates: Iterable[Estimate]) -> dict[Key, list[Estimate]]:
    by_key: dict[Key, list[Estimate]] = defaultdict(list)
    for estimate in estimates:
        by_key[estimate.scene_id, estimate.im_id, estimate.obj_id].append(estimate)
    return by_key


@dataclass(frozen=True, kw_only=True)
class _Start:
    line: int
    key: Key
    gt_index: int
    level: Level | None


def _planned(perturbation: Any, result: ResultFile) -> list[_Start]:
    try:
        return [
            _Start(
                line=int(row["line"]),
                key=(int(row["scene_id"]), int(row["im_id"]), int(row["obj_id"])),
                gt_index=int(row["gt_index"]),
                level=_level(row),
            )
            for row in perturbation["rows"]
        ]
    except (KeyError, TypeError, ValueError) as error:
        raise ResultFileError(
            f"{result.path}.json: 'perturbation' is not what `evalkit perturb` writes ({error!r}); "
            "copy it unchanged from the start poses' sidecar"
        ) from error


def _level(row: dict[str, Any]) -> Level | None:
    """The level of a start; None for one drawn at random, which belongs to no curve."""
    level = Level(angle_deg=float(row["angle_deg"]), translation_diameter=float(row["translation_diameter"]))
    return None if row["random"] else level


def _pair_starts(dataset: BopDataset, result: ResultFile, starts: Sequence[_Start]) -> Pairing:
    """Every start with its estimate: by the sidecar's `initial_lines`, else in order within image and object."""
    estimates = _by_start_line(result, starts)
    pairs = []
    for start in starts:
        scene_id, im_id, _ = start.key
        truths = dataset.gt(scene_id, im_id)
        if start.gt_index >= len(truths):
            raise ResultFileError(f"{result.path}.json: image {im_id} of scene {scene_id} has no pose {start.gt_index}")
        truth = truths[start.gt_index]
        pairs.append(
            Pair(scene_id=scene_id, im_id=im_id, truth=truth, estimate=estimates.get(start.line), level=start.level)
        )
    used = sum(pair.estimate is not None for pair in pairs)
    return Pairing(pairs=pairs, ignored=len(result.estimates) - used)


def _by_start_line(result: ResultFile, starts: Sequence[_Start]) -> dict[int, Estimate]:
    lines = result.sidecar.get("initial_lines")
    if lines is not None:
        if not isinstance(lines, list) or len(lines) != len(result.estimates):
            raise ResultFileError(
                f"{result.path}.json: 'initial_lines' must hold a number for each of {len(result.estimates)} estimates"
            )
        return {int(line): estimate for line, estimate in zip(lines, result.estimates, strict=True)}
    by_key = _by_key(result.estimates)
    planned = Counter(start.key for start in starts)
    for key, count in planned.items():
        if len(by_key.get(key, [])) not in (0, count):
            raise ResultFileError(
                f"{result.path}: {len(by_key[key])} estimates of object {key[2]} in scene {key[0]}, image {key[1]}, "
                f"but {count} starts; write one line for each start, or 'initial_lines' in the sidecar"
            )
    queues = {key: iter(estimates) for key, estimates in by_key.items()}
    return {start.line: next(queues[start.key]) for start in starts if start.key in queues}
