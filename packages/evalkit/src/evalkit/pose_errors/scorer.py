"""Pairs of poses to columns of errors, one block of pairs at a time."""

from collections import OrderedDict, defaultdict
from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float
from posecore.bop import BopDataset, GroundTruth
from posecore.camera import Camera
from posecore.errors import DatasetError
from posecore.raster import Rasteriser

from evalkit.error_table import table_of
from evalkit.inputs.pairing import MatchedPose
from evalkit.pose_errors import metrics, silhouettes
from evalkit.pose_errors.metrics import VSD_COLUMNS, VSD_TAUS
from evalkit.pose_errors.per_object import ERRORS, Model, pose_errors
from evalkit.pose_errors.silhouettes import Patch

KEPT_BYTES = 256_000_000
"""Memory for renders of ground-truth poses, kept for the next result file."""

KEPT_IMAGES = 5_000
"""Number of images whose cameras and ground-truth poses are kept."""

Columns = dict[str, Float[np.ndarray, " n"]]


class Scorer:
    """Errors of pairs against one dataset; models and the last ground-truth renders are kept between blocks.

    Args:
        dataset: with ground truth.
        visible: VSS of visible parts instead of whole silhouettes, which needs depth images.
        with_vsd: whether VSD is added where an image has depth.

    Attributes:
        centers_m: centres of objects, object frame, metres, which full models are read for where they are missing.
    """

    def __init__(self, dataset: BopDataset, *, visible: bool, with_vsd: bool) -> None:
        self.dataset, self._visible, self._with_vsd = dataset, visible, with_vsd
        self.rasteriser = Rasteriser({})
        self.camera: Callable[[int, int], Camera] = lru_cache(KEPT_IMAGES)(dataset.camera)
        self.gt: Callable[[int, int], list[GroundTruth]] = lru_cache(KEPT_IMAGES)(dataset.gt)
        self._depth_m = lru_cache(1)(dataset.depth_m)  # pairs come image by image
        self.centers_m: dict[int, Float[np.ndarray, "3"]] = {}
        self._models: dict[int, Model] = {}
        self._gt_patches: OrderedDict[tuple[int, int, int], Patch] = OrderedDict()

    def score(self, pairs: Sequence[MatchedPose]) -> pd.DataFrame:
        """One row for each pair, in their order.

        Raises:
            DatasetError: a model is missing, or VSS of visible parts needs depth that an image does not have.
        """
        instances, estimates = [pair.gt for pair in pairs], [pair.estimate for pair in pairs]
        models = [self.model(gt.obj_id) for gt in instances]
        cameras = [self.camera(pair.scene_id, pair.im_id) for pair in pairs]
        centers = [model.of_center(gt.T_cam_obj) for model, gt in zip(models, instances, strict=True)]
        T_gt_center = np.array(centers, np.float64).reshape(-1, 4, 4)
        azimuth_deg, elevation_deg = metrics.viewpoint_deg(T_gt_center)
        vss, vsd = self._silhouettes(pairs)
        nan = np.nan
        columns: dict[str, Sequence[Any] | np.ndarray] = {
            "scene_id": [pair.scene_id for pair in pairs],
            "im_id": [pair.im_id for pair in pairs],
            "obj_id": [gt.obj_id for gt in instances],
            "gt_index": [gt.gt_index for gt in instances],
            "visib_fract": [nan if gt.visib_fract is None else gt.visib_fract for gt in instances],
            "found": [estimate is not None for estimate in estimates],
            "line": [0 if estimate is None else estimate.line for estimate in estimates],
            "score": [nan if estimate is None else estimate.score for estimate in estimates],
            "time_s": [nan if estimate is None else estimate.time_s for estimate in estimates],
            "initial_angle_deg": [nan if pair.level is None else pair.level.angle_deg for pair in pairs],
            "initial_translation_diameter": [
                nan if pair.level is None else pair.level.translation_diameter for pair in pairs
            ],
            "diameter_m": [model.info.diameter_m for model in models],
            "symmetric": [model.info.is_symmetric for model in models],
            "image_width_px": [camera.width_px for camera in cameras],
            "distance_m": T_gt_center[:, 2, 3],
            "view_azimuth_deg": azimuth_deg,
            "view_elevation_deg": elevation_deg,
            "other_mssd_m": self._other_mssd_m(pairs),
            "vss": vss,
            **self._pose_errors(pairs),
        }
        if self._with_vsd:
            columns |= dict(zip(VSD_COLUMNS, vsd.T, strict=True))
        return table_of(columns)

    def model(self, obj_id: int) -> Model:
        """An object's model (of `models_eval` where the dataset has it), read once.

        Raises:
            DatasetError: the dataset has none.
        """
        if obj_id not in self._models:
            if obj_id not in self.dataset.models_info:
                raise DatasetError(f"{self.dataset.root}: models_info.json has no object {obj_id}; add its diameter")
            mesh, info = self.dataset.mesh(obj_id, eval=True), self.dataset.models_info[obj_id]
            if obj_id not in self.centers_m:
                self.centers_m[obj_id] = self.dataset.center_m(obj_id)
            model = Model(mesh=mesh, info=info, center_m=self.centers_m[obj_id])
            self.rasteriser.add(obj_id, model.mesh)
            self._models[obj_id] = model
        return self._models[obj_id]

    def _pose_errors(self, pairs: Sequence[MatchedPose]) -> Columns:
        columns = {name: np.full(len(pairs), np.nan) for name in ERRORS}
        for obj_id, indices in _by_object(pairs):
            estimated = [pairs[index] for index in indices]
            K = np.stack([self.camera(pair.scene_id, pair.im_id).K for pair in estimated])
            T_gt = np.stack([pair.gt.T_cam_obj for pair in estimated])
            for name, values in pose_errors(self.model(obj_id), _estimated(estimated), T_gt, K).items():
                columns[name][indices] = values
        return columns

    def _other_mssd_m(self, pairs: Sequence[MatchedPose]) -> Float[np.ndarray, " n"]:
        """Smallest MSSD of each estimate to another instance of its object in the image, NaN without one."""
        result = np.full(len(pairs), np.inf)
        for obj_id, indices in _by_object(pairs):
            others = [
                (index, gt.T_cam_obj)
                for index in indices
                for gt in self.gt(pairs[index].scene_id, pairs[index].im_id)
                if gt.obj_id == obj_id and gt.has_pose and gt.gt_index != pairs[index].gt.gt_index
            ]
            if others:
                rows, T_other = [row for row, _ in others], np.stack([T for _, T in others])
                model = self.model(obj_id)
                T_est = _estimated([pairs[row] for row in rows])
                errors_m = metrics.mssd(T_est, T_other, model.hull_m, model.symmetries_of(T_est, T_other))
                np.minimum.at(result, rows, errors_m)
        return np.where(np.isfinite(result), result, np.nan)

    def _silhouettes(self, pairs: Sequence[MatchedPose]) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n t"]]:
        """VSS of each pair, 0 where missing, and VSD for every tolerance, NaN where missing or without depth."""
        vss, vsd = np.zeros(len(pairs)), np.full((len(pairs), len(VSD_TAUS)), np.nan)
        self._render_ground_truth(pairs)
        patches: dict[int, Patch] = {}
        for obj_id, indices in _by_object(pairs):
            poses = _estimated([pairs[index] for index in indices])
            patches |= zip(indices, self._render(obj_id, [pairs[index] for index in indices], poses), strict=True)
        for index in sorted(patches, key=lambda index: (pairs[index].scene_id, pairs[index].im_id)):
            vss[index], vsd[index] = self._compare(pairs[index], patches[index])
        self._trim_cache()
        return vss, vsd

    def _render_ground_truth(self, pairs: Sequence[MatchedPose]) -> None:
        missing: dict[int, dict[tuple[int, int, int], MatchedPose]] = defaultdict(dict)
        for pair in pairs:
            if pair.estimate is None:
                continue
            if (key := _gt_key(pair)) in self._gt_patches:
                self._gt_patches.move_to_end(key)
            else:
                missing[pair.gt.obj_id][key] = pair
        for obj_id, new in missing.items():
            poses = np.stack([pair.gt.T_cam_obj for pair in new.values()])
            self._gt_patches |= zip(new, self._render(obj_id, list(new.values()), poses), strict=True)

    def _trim_cache(self) -> None:
        """Keep the renders used last, within `KEPT_BYTES`."""
        size = sum(patch.depth_m.nbytes for patch in self._gt_patches.values())
        while size > KEPT_BYTES:
            size -= self._gt_patches.popitem(last=False)[1].depth_m.nbytes

    def _render(self, obj_id: int, pairs: Sequence[MatchedPose], T_cam_obj: Float[np.ndarray, "b 4 4"]) -> list[Patch]:
        hull_m = self.model(obj_id).hull_m
        cameras = [self.camera(pair.scene_id, pair.im_id) for pair in pairs]
        return [
            silhouettes.render_patch(self.rasteriser, obj_id, hull_m, camera, pose)
            for camera, pose in zip(cameras, T_cam_obj, strict=True)
        ]

    def _compare(self, pair: MatchedPose, patch: Patch) -> tuple[float, Float[np.ndarray, " t"]]:
        gt_patch, K = self._gt_patches[_gt_key(pair)], self.camera(pair.scene_id, pair.im_id).K
        depth_m = self._depth_m(pair.scene_id, pair.im_id) if self._visible or self._with_vsd else None
        if self._visible and depth_m is None:
            scene = self.dataset.scene_path(pair.scene_id)
            raise DatasetError(
                f"{scene / 'depth'}: image {pair.im_id} has no depth, which --vss visible needs; use --vss full"
            )
        vsd = np.full(len(VSD_TAUS), np.nan)
        if self._with_vsd and depth_m is not None:
            taus_m = VSD_TAUS * self.dataset.models_info[pair.gt.obj_id].diameter_m
            vsd = silhouettes.vsd(patch, gt_patch, K, depth_m, taus_m)
        if self._visible and depth_m is not None:
            return silhouettes.vss_visible(patch, gt_patch, K, depth_m), vsd
        return silhouettes.vss_full(patch, gt_patch), vsd


def _estimated(pairs: Sequence[MatchedPose]) -> Float[np.ndarray, "b 4 4"]:
    return np.stack([pair.estimate.T_cam_obj for pair in pairs if pair.estimate is not None])


def _gt_key(pair: MatchedPose) -> tuple[int, int, int]:
    return pair.scene_id, pair.im_id, pair.gt.gt_index


def _by_object(pairs: Sequence[MatchedPose]) -> Iterator[tuple[int, list[int]]]:
    """Objects with the indices of their pairs that have an estimate."""
    indices: dict[int, list[int]] = defaultdict(list)
    for index, pair in enumerate(pairs):
        if pair.estimate is not None:
            indices[pair.gt.obj_id].append(index)
    yield from sorted(indices.items())
