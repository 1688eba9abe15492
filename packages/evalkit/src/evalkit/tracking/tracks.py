"""Sequences of a result file: one object along one scene, and the frames in which its tracker was set to the truth."""

from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from jaxtyping import Bool, Float, Int
from posecore.bop import BopDataset, BopTarget, Estimate, GroundTruth
from posecore.errors import ResultFileError
from posecore.symmetry import Symmetric
from scipy.optimize import linear_sum_assignment

from evalkit.inputs.pairing import truths_of
from evalkit.inputs.result_files import ResultFile

Array = np.ndarray


@dataclass(frozen=True, kw_only=True, eq=False)
class Track:
    """One object along one sequence, frames in order.

    Attributes:
        scene_id: sequence.
        obj_id: object.
        instance: which of several alike, counted from 0 in the order of the images' lists.
        name: for tables.
        im_id: (n,) images.
        frame: (n,) their places in the sequence: neighbours differ by 1.
        T_est: (n, 4, 4) estimates, metres, NaN where there is none.
        T_gt: (n, 4, 4) truths.
        time_s: (n,) run times, NaN or negative where unknown.
        given: (n,) frames in which the tracker was set to the truth, None for a run without resets.
        info: symmetries.
    """

    scene_id: int
    obj_id: int
    instance: int
    name: str
    im_id: Int[Array, " n"]
    frame: Int[Array, " n"]
    T_est: Float[Array, "n 4 4"]
    T_gt: Float[Array, "n 4 4"]
    time_s: Float[Array, " n"]
    given: Bool[Array, " n"] | None
    info: Symmetric | None


def tracks_of(
    dataset: BopDataset,
    file: ResultFile,
    table: pd.DataFrame,
    T_est: Float[Array, "n 4 4"],
    T_gt: Float[Array, "n 4 4"],
) -> list[Track]:
    """The sequences of a result file: one track for each object of each scene.

    Args:
        dataset: with ground truth; the images of a scene are its frames, in rising order.
        file: where its sidecar has `resets`, a list of `{"scene_id": .., "im_id": .., "obj_id": ..}` (and `"instance"`
            for one of several alike), these are the frames in which the tracker was set to the truth: the first frame
            of a sequence and, under RBOT's protocol, every frame that failed. What the file holds for such a frame is
            not scored.
        table: `scene_id`, `im_id`, `obj_id`, `gt_index` and `time_s`, one row for each expected pose.
        T_est: (n, 4, 4) estimates, metres, NaN where missing.
        T_gt: (n, 4, 4) truths.

    Raises:
        ResultFileError: several poses of an instance in an image, as perturbed starts have, or broken `resets`.
    """
    resets = _resets(file, dataset)
    keys = table[["scene_id", "obj_id"]].copy()
    keys["instance"] = [
        _instance(dataset, *(int(value) for value in row))
        for row in table[["scene_id", "im_id", "obj_id", "gt_index"]].itertuples(index=False)
    ]
    several = set(map(tuple, keys.loc[keys.instance > 0, ["scene_id", "obj_id"]].to_numpy().tolist()))
    im_id, time_s = table.im_id.to_numpy(np.int64), table.time_s.to_numpy(np.float64)
    tracks = []
    for (scene_id, obj_id, instance), places in keys.groupby(list(keys.columns), sort=True).indices.items():
        rows = places[np.argsort(im_id[places], kind="stable")]
        images = im_id[rows]
        if (np.diff(images) == 0).any():
            twice = int(images[:-1][np.diff(images) == 0][0])
            raise ResultFileError(
                f"{file.path}: object {obj_id} in scene {scene_id}, image {twice} has several poses of one instance; "
                "a tracked sequence has one (perturbed starts belong into `evalkit report`)"
            )
        mark = f", instance {instance + 1}" if (scene_id, obj_id) in several else ""
        given = None
        if resets is not None:
            given = np.array([(scene_id, image, obj_id, instance) in resets for image in images.tolist()], bool)
        tracks.append(
            Track(
                scene_id=int(scene_id),
                obj_id=int(obj_id),
                instance=int(instance),
                name=f"scene {scene_id}, object {obj_id}{mark}",
                im_id=images,
                frame=np.searchsorted(np.array(dataset.im_ids(int(scene_id))), images).astype(np.int64),
                T_est=T_est[rows],
                T_gt=T_gt[rows],
                time_s=time_s[rows],
                given=given,
                info=dataset.models_info[int(obj_id)],
            )
        )
    return tracks


def frames_of(
    dataset: BopDataset, file: ResultFile, *, all_frames: bool = False
) -> tuple[pd.DataFrame, Float[Array, "n 4 4"], Float[Array, "n 4 4"]]:
    """Every pose that a tracker is expected to find, with its estimate: what `tracks_of` takes.

    Of the estimates of an object in an image those with the highest scores count, as many as there are instances; they
    go to the instances so that distances of the origins add up to the least.

    Args:
        dataset: with ground truth.
        file: with estimates.
        all_frames: every pose that is annotated in scenes that the targets name, instead of the targets only: targets
            may leave out frames of a video, or poses that are hardly visible.

    Returns:
        Table with `scene_id`, `im_id`, `obj_id`, `gt_index`, `time_s`; estimates, NaN where missing; truths.
    """
    estimates: dict[tuple[int, int, int], list[Estimate]] = defaultdict(list)
    for estimate in file.estimates:
        estimates[estimate.scene_id, estimate.im_id, estimate.obj_id].append(estimate)
    rows, T_est, T_gt = [], [], []
    for target in _every_pose(dataset) if all_frames else dataset.targets:
        key = (target.scene_id, target.im_id, target.obj_id)
        truths = sorted(truths_of(dataset, target)[: target.inst_count], key=lambda gt: gt.gt_index)
        best = sorted(estimates[key], key=lambda estimate: -estimate.score)[: len(truths)]
        matched = _matched(best, truths)
        for place, truth in enumerate(truths):
            found = matched.get(place)
            rows.append((*key, truth.gt_index, np.nan if found is None else found.time_s))
            T_est.append(np.full((4, 4), np.nan) if found is None else found.T_cam_obj)
            T_gt.append(truth.T_cam_obj)
    table = pd.DataFrame(rows, columns=["scene_id", "im_id", "obj_id", "gt_index", "time_s"])
    return table, np.array(T_est).reshape(-1, 4, 4), np.array(T_gt).reshape(-1, 4, 4)


def _every_pose(dataset: BopDataset) -> list[BopTarget]:
    targets = []
    for scene_id in sorted({target.scene_id for target in dataset.targets}):
        for im_id in dataset.im_ids(scene_id):
            count = Counter(gt.obj_id for gt in dataset.gt(scene_id, im_id) if gt.has_pose)
            targets += [
                BopTarget(scene_id=scene_id, im_id=im_id, obj_id=obj_id, inst_count=n) for obj_id, n in count.items()
            ]
    return targets


def _matched(estimates: Sequence[Estimate], truths: Sequence[GroundTruth]) -> dict[int, Estimate]:
    """Estimate of each truth by its place."""
    if len(truths) == 1:
        return dict(enumerate(estimates))
    distance = [[np.linalg.norm(e.T_cam_obj[:3, 3] - gt.T_cam_obj[:3, 3]) for gt in truths] for e in estimates]
    which, places = linear_sum_assignment(np.array(distance).reshape(len(estimates), len(truths)))
    return {int(place): estimates[int(number)] for number, place in zip(which, places, strict=True)}


def _instance(dataset: BopDataset, scene_id: int, im_id: int, obj_id: int, gt_index: int) -> int:
    return sum(gt.obj_id == obj_id and gt.gt_index < gt_index for gt in dataset.gt(scene_id, im_id))


def _resets(file: ResultFile, dataset: BopDataset) -> set[tuple[int, int, int, int]] | None:
    """Scene, image, object and instance of the frames in which the tracker was set to the truth."""
    listed = file.sidecar.get("resets")
    if listed is None:
        return None
    where = f"{file.path}.json: 'resets'"
    if not isinstance(listed, list):
        raise ResultFileError(f"{where} is a {type(listed).__name__}, expected a list of scene_id, im_id, obj_id")
    resets = set()
    for number, entry in enumerate(listed):
        names = ("scene_id", "im_id", "obj_id", "instance")
        values = [{"instance": 0, **entry}.get(name) for name in names] if isinstance(entry, dict) else []
        ids = [value for value in values if isinstance(value, int) and not isinstance(value, bool)]
        if len(ids) != len(names):
            raise ResultFileError(f"{where}, entry {number}: expected whole numbers scene_id, im_id, obj_id")
        if ids[0] not in dataset.scene_ids or ids[1] not in dataset.im_ids(ids[0]):
            raise ResultFileError(f"{where}, entry {number}: there is no image {ids[1]} in scene {ids[0]}")
        resets.add((ids[0], ids[1], ids[2], ids[3]))
    return resets
