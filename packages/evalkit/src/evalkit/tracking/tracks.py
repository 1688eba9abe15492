"""Sequences of a result file: an object along a scene, and the frames in which its tracker was initialised."""

from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from jaxtyping import Bool, Float, Int
from posecore import se3
from posecore.bop import BopDataset, BopTarget, Estimate, GroundTruth
from posecore.errors import ResultFileError
from posecore.symmetry import Symmetric
from scipy.optimize import linear_sum_assignment

from evalkit.inputs.pairing import distances_of_centers_m
from evalkit.inputs.result_files import ResultFile


@dataclass(frozen=True, kw_only=True, eq=False)
class SequenceTrack:
    """One object along one sequence, frames in order.

    Attributes:
        scene_id: sequence.
        obj_id: object.
        instance: number among several instances of the object, from 0, in order of the images' annotations.
        name: for tables.
        im_id: (n,) images.
        frame: (n,) indices of the images in the sequence: neighbours differ by 1.
        T_est: (n, 4, 4) estimates of the object's centre, metres, NaN where there is none.
        T_gt: (n, 4, 4) ground truth of the centre.
        time_s: (n,) run times, NaN or negative where unknown.
        was_initialised: (n,) frames in which the tracker was set to the ground truth, None for a run without resets.
        info: symmetries in the frame about the centre.
    """

    scene_id: int
    obj_id: int
    instance: int
    name: str
    im_id: Int[np.ndarray, " n"]
    frame: Int[np.ndarray, " n"]
    T_est: Float[np.ndarray, "n 4 4"]
    T_gt: Float[np.ndarray, "n 4 4"]
    time_s: Float[np.ndarray, " n"]
    was_initialised: Bool[np.ndarray, " n"] | None
    info: Symmetric | None


def tracks_of(
    dataset: BopDataset,
    file: ResultFile,
    table: pd.DataFrame,
    T_est: Float[np.ndarray, "n 4 4"],
    T_gt: Float[np.ndarray, "n 4 4"],
) -> list[SequenceTrack]:
    """The sequences of a result file: one track for each object of each scene.

    Args:
        dataset: with ground truth; the images of a scene are its frames, in rising order.
        file: where its sidecar has `resets`, a list of `{"scene_id": .., "im_id": .., "obj_id": ..}` (and `"instance"`
            for one of several instances), these are the frames in which the tracker was set to the ground truth: the
            first frame of a sequence and, under RBOT's protocol, every failed frame. The file's poses of these frames
            are not scored.
        table: `scene_id`, `im_id`, `obj_id`, `gt_index` and `time_s`, one row for each expected pose.
        T_est: (n, 4, 4) estimates of the objects' own origins, as files hold them, metres, NaN where missing.
        T_gt: (n, 4, 4) ground truth.

    Raises:
        ResultFileError: several poses of an instance in an image, as perturbed initial poses have, or broken `resets`.
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
    for (scene_id, obj_id, instance), indices in keys.groupby(list(keys.columns), sort=True).indices.items():
        rows = indices[np.argsort(im_id[indices], kind="stable")]
        images = im_id[rows]
        if (np.diff(images) == 0).any():
            twice = int(images[:-1][np.diff(images) == 0][0])
            raise ResultFileError(
                f"{file.path}: object {obj_id} in scene {scene_id}, image {twice} has several poses of the object; "
                "a tracked sequence has one (perturbed initial poses are for `evalkit report`)"
            )
        center_m = dataset.center_m(int(obj_id))
        mark = f", instance {instance + 1}" if (scene_id, obj_id) in several else ""
        tracks.append(
            SequenceTrack(
                scene_id=int(scene_id),
                obj_id=int(obj_id),
                instance=int(instance),
                name=f"scene {scene_id}, object {obj_id}{mark}",
                im_id=images,
                frame=np.searchsorted(np.array(dataset.im_ids(int(scene_id))), images).astype(np.int64),
                T_est=se3.with_origin_at(T_est[rows], center_m),
                T_gt=se3.with_origin_at(T_gt[rows], center_m),
                time_s=time_s[rows],
                was_initialised=_were_initialised(resets, images, int(scene_id), int(obj_id), int(instance)),
                info=dataset.models_info[int(obj_id)].with_origin_at(center_m),
            )
        )
    return tracks


def _were_initialised(
    resets: set[tuple[int, int, int, int]] | None,
    im_id: Int[np.ndarray, " n"],
    scene_id: int,
    obj_id: int,
    instance: int,
) -> Bool[np.ndarray, " n"] | None:
    if resets is None:
        return None
    return np.array([(scene_id, image, obj_id, instance) in resets for image in im_id.tolist()], bool)


def frames_of(
    dataset: BopDataset, file: ResultFile, *, all_frames: bool = False
) -> tuple[pd.DataFrame, Float[np.ndarray, "n 4 4"], Float[np.ndarray, "n 4 4"]]:
    """Every expected pose with its estimate, as arguments of `tracks_of`.

    Of the estimates of an object in an image those with the highest scores count, as many as there are instances; they
    go to the instances so that distances of the centres add up to the least.

    Args:
        dataset: with ground truth.
        file: with estimates.
        all_frames: every annotated pose in the targets' scenes, not only the targets, which may leave out frames of a
            video or poses that are hardly visible.

    Returns:
        Table with `scene_id`, `im_id`, `obj_id`, `gt_index`, `time_s`; estimates, NaN where missing; ground truth.
    """
    estimates: dict[tuple[int, int, int], list[Estimate]] = defaultdict(list)
    for estimate in file.estimates:
        estimates[estimate.scene_id, estimate.im_id, estimate.obj_id].append(estimate)
    rows, T_est, T_gt = [], [], []
    for target in _every_pose(dataset) if all_frames else dataset.targets:
        key = (target.scene_id, target.im_id, target.obj_id)
        instances = sorted(dataset.instances(target), key=lambda gt: gt.gt_index)
        best = sorted(estimates[key], key=lambda estimate: -estimate.score)[: len(instances)]
        matched = _matched(dataset, best, instances)
        for index, gt in enumerate(instances):
            of_instance = matched.get(index)
            rows.append((*key, gt.gt_index, np.nan if of_instance is None else of_instance.time_s))
            T_est.append(np.full((4, 4), np.nan) if of_instance is None else of_instance.T_cam_obj)
            T_gt.append(gt.T_cam_obj)
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


def _matched(
    dataset: BopDataset, estimates: Sequence[Estimate], instances: Sequence[GroundTruth]
) -> dict[int, Estimate]:
    """Estimate of each instance by its index."""
    if len(instances) == 1:
        return dict(enumerate(estimates))
    which, indices = linear_sum_assignment(distances_of_centers_m(dataset, estimates, instances))
    return {int(index): estimates[int(number)] for number, index in zip(which, indices, strict=True)}


def _instance(dataset: BopDataset, scene_id: int, im_id: int, obj_id: int, gt_index: int) -> int:
    return sum(gt.obj_id == obj_id and gt.gt_index < gt_index for gt in dataset.gt(scene_id, im_id))


def _resets(file: ResultFile, dataset: BopDataset) -> set[tuple[int, int, int, int]] | None:
    """Scene, image, object and instance of the frames in which the tracker was initialised."""
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
