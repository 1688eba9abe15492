"""Every expected pose with its estimate, or with none."""

from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float
from posecore import se3
from posecore.bop import BopDataset, Estimate, GroundTruth
from posecore.bop.perturbation import Level
from posecore.errors import ResultFileError

from evalkit.inputs.result_files import ResultFile

Key = tuple[int, int, int]


@dataclass(frozen=True, kw_only=True, eq=False)
class MatchedPose:
    """One expected pose: ground truth, estimate or None, and the level of an initial pose perturbed by steps."""

    scene_id: int
    im_id: int
    gt: GroundTruth
    estimate: Estimate | None
    level: Level | None = None


@dataclass(frozen=True, kw_only=True)
class Pairing:
    """All pairs of a result file, and the number of its lines without an expected pose."""

    pairs: list[MatchedPose]
    ignored: int


def pair_up(dataset: BopDataset, result: ResultFile) -> Pairing:
    """Pair a result file with ground truth: by initial pose where the sidecar has a perturbation, else by target."""
    perturbation = result.sidecar.get("perturbation")
    if perturbation is None:
        return _pair_targets(dataset, result)
    return _pair_initial_poses(dataset, result, _initial_poses(perturbation, result))


def _pair_targets(dataset: BopDataset, result: ResultFile) -> Pairing:
    """For every target its `inst_count` best-scored estimates; each takes the nearest free instance."""
    by_key = _by_key(result.estimates)
    pairs: list[MatchedPose] = []
    for target in dataset.targets:
        instances = dataset.instances(target)
        candidates = by_key.get((target.scene_id, target.im_id, target.obj_id), [])
        best = sorted(candidates, key=lambda estimate: -estimate.score)[: target.inst_count]
        matched: list[tuple[GroundTruth, Estimate | None]] = []
        for estimate in best[: len(instances)]:
            free = [gt for gt in instances if all(gt is not other for other, _ in matched)]
            matched.append((_nearest(dataset, estimate, free), estimate))
        unmatched = [gt for gt in instances if all(gt is not other for other, _ in matched)]
        matched += [(gt, None) for gt in unmatched]
        pairs += [
            MatchedPose(scene_id=target.scene_id, im_id=target.im_id, gt=gt, estimate=estimate)
            for gt, estimate in matched
        ]
    used = sum(pair.estimate is not None for pair in pairs)
    return Pairing(pairs=pairs, ignored=len(result.estimates) - used)


def _nearest(dataset: BopDataset, estimate: Estimate, instances: Sequence[GroundTruth]) -> GroundTruth:
    """The instance whose centre is nearest; of equal ones the first."""
    if len(instances) == 1:
        return instances[0]
    distances_m = distances_of_centers_m(dataset, [estimate], instances)
    return instances[int(distances_m[0].argmin())]


def distances_of_centers_m(
    dataset: BopDataset, estimates: Sequence[Estimate], instances: Sequence[GroundTruth]
) -> Float[np.ndarray, "e i"]:
    """Distances between the object's centre at estimates and at ground-truth poses of one object, metres."""
    center_m = dataset.center_m(instances[0].obj_id)
    est, gt = (
        se3.with_origin_at(np.array([item.T_cam_obj for item in items], np.float64).reshape(-1, 4, 4), center_m)
        for items in (estimates, instances)
    )
    return np.asarray(np.linalg.norm(est[:, None, :3, 3] - gt[:, :3, 3], axis=-1))


def _by_key(estimates: Iterable[Estimate]) -> dict[Key, list[Estimate]]:
    by_key: dict[Key, list[Estimate]] = defaultdict(list)
    for estimate in estimates:
        by_key[estimate.scene_id, estimate.im_id, estimate.obj_id].append(estimate)
    return by_key


@dataclass(frozen=True, kw_only=True)
class _InitialPose:
    line: int
    key: Key
    gt_index: int
    level: Level | None


def _initial_poses(perturbation: Any, result: ResultFile) -> list[_InitialPose]:
    try:
        return [
            _InitialPose(
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
            "copy it unchanged from the initial poses' sidecar"
        ) from error


def _level(row: dict[str, Any]) -> Level | None:
    """The level of an initial pose; None for one drawn at random, which belongs to no curve."""
    level = Level(angle_deg=float(row["angle_deg"]), translation_diameter=float(row["translation_diameter"]))
    return None if row["random"] else level


def _pair_initial_poses(dataset: BopDataset, result: ResultFile, initial_poses: Sequence[_InitialPose]) -> Pairing:
    """Every initial pose with its estimate: by the sidecar's `initial_lines`, else in order within image and object."""
    estimates = _by_initial_line(result, initial_poses)
    pairs = []
    for initial in initial_poses:
        scene_id, im_id, _ = initial.key
        instances = dataset.gt(scene_id, im_id)
        if initial.gt_index >= len(instances):
            raise ResultFileError(
                f"{result.path}.json: image {im_id} of scene {scene_id} has no pose {initial.gt_index}"
            )
        gt = instances[initial.gt_index]
        pairs.append(
            MatchedPose(
                scene_id=scene_id, im_id=im_id, gt=gt, estimate=estimates.get(initial.line), level=initial.level
            )
        )
    used = sum(pair.estimate is not None for pair in pairs)
    return Pairing(pairs=pairs, ignored=len(result.estimates) - used)


def _by_initial_line(result: ResultFile, initial_poses: Sequence[_InitialPose]) -> dict[int, Estimate]:
    lines = result.sidecar.get("initial_lines")
    if lines is not None:
        if not isinstance(lines, list) or len(lines) != len(result.estimates):
            raise ResultFileError(
                f"{result.path}.json: 'initial_lines' must hold {len(result.estimates)} numbers, one for each estimate"
            )
        return {int(line): estimate for line, estimate in zip(lines, result.estimates, strict=True)}
    by_key = _by_key(result.estimates)
    expected = Counter(initial.key for initial in initial_poses)
    for key, count in expected.items():
        if len(by_key.get(key, [])) not in (0, count):
            raise ResultFileError(
                f"{result.path}: {len(by_key[key])} estimates of object {key[2]} in scene {key[0]}, image {key[1]}, "
                f"but {count} initial poses; write one line for each, or 'initial_lines' in the sidecar"
            )
    queues = {key: iter(estimates) for key, estimates in by_key.items()}
    return {initial.line: next(queues[initial.key]) for initial in initial_poses if initial.key in queues}
