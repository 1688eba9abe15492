"""Pairs of poses to columns of errors, a block of them at a time."""

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
from evalkit.inputs.pairing import Pair
from evalkit.pose_errors import metrics, silhouettes
from evalkit.pose_errors.metrics import VSD_COLUMNS, VSD_TAUS
from evalkit.pose_errors.per_object import ERRORS, Model, pose_errors
from evalkit.pose_errors.silhouettes import Patch

Array = np.ndarray
KEPT_BYTES = 256_000_000
"""Renders of true poses that are kept for the next result file."""

KEPT_IMAGES = 5_000
"""Images whose cameras and true poses are kept."""

Columns = dict[str, Float[Array, " n"]]


class Scorer:
    """Scores pairs against one dataset; what is made for a block of pairs is forgotten after it, but for what is kept.

    Args:
        dataset: with ground truth.
        visible: VSS of visible parts instead of whole silhouettes, which needs depth images.
        with_vsd: whether VSD is added where an image has depth.
    """

    def __init__(self, dataset: BopDataset, *, visible: bool, with_vsd: bool) -> None:
        self.dataset, self._visible, self._with_vsd = dataset, visible, with_vsd
        self.rasteriser = Rasteriser({})
        self.camera: Callable[[int, int], Camera] = lru_cache(KEPT_IMAGES)(dataset.camera)
        self.gt: Callable[[int, int], list[GroundTruth]] = lru_cache(KEPT_IMAGES)(dataset.gt)
        self._depth_m = lru_cache(1)(dataset.depth_m)  # pairs come image by image
        self._models: dict[int, Model] = {}
        self._truths: OrderedDict[tuple[int, int, int], Patch] = OrderedDict()

    def score(self, pairs: Sequence[Pair]) -> pd.DataFrame:
        """One row for each pair, in their order.

        Raises:
            DatasetError: a model is missing, or VSS of visible parts is wanted and an image has no depth.
        """
        truths, estimates = [pair.truth for pair in pairs], [pair.estimate for pair in pairs]
        infos = [self.model(truth.obj_id).info for truth in truths]
        cameras = [self.camera(pair.scene_id, pair.im_id) for pair in pairs]
        T_gt = np.array([truth.T_cam_obj for truth in truths], np.float64).reshape(-1, 4, 4)
        azimuth_deg, elevation_deg = metrics.viewpoint_deg(T_gt)
        vss, vsd = self._silhouettes(pairs)
        nan = np.nan
        columns: dict[str, Sequence[Any] | Array] = {
            "scene_id": [pair.scene_id for pair in pairs],
            "im_id": [pair.im_id for pair in pairs],
            "obj_id": [truth.obj_id for truth in truths],
            "gt_index": [truth.gt_index for truth in truths],
            "visib_fract": [nan if truth.visib_fract is None else truth.visib_fract for truth in truths],
            "found": [estimate is not None for estimate in estimates],
            "line": [0 if estimate is None else estimate.line for estimate in estimates],
            "score": [nan if estimate is None else estimate.score for estimate in estimates],
            "time_s": [nan if estimate is None else estimate.time_s for estimate in estimates],
            "start_angle_deg": [nan if pair.level is None else pair.level.angle_deg for pair in pairs],
            "start_translation_diameter": [
                nan if pair.level is None else pair.level.translation_diameter for pair in pairs
            ],
            "diameter_m": [info.diameter_m for info in infos],
            "symmetric": [info.is_symmetric for info in infos],
            "image_width_px": [camera.width_px for camera in cameras],
            "distance_m": T_gt[:, 2, 3],
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
        """An object's model (of `models_eval` where there is one), read once.

        Raises:
            DatasetError: the dataset has none.
        """
        if obj_id not in self._models:
            if obj_id not in self.dataset.models_info:
                raise DatasetError(f"{self.dataset.root}: models_info.json has no object {obj_id}; add its diameter")
            model = Model(mesh=self.dataset.mesh(obj_id, eval=True), info=self.dataset.models_info[obj_id])
            self.rasteriser.add(obj_id, model.mesh)
            self._models[obj_id] = model
        return self._models[obj_id]

    def _pose_errors(self, pairs: Sequence[Pair]) -> Columns:
        columns = {name: np.full(len(pairs), np.nan) for name in ERRORS}
        for obj_id, indices in _by_object(pairs):
            found = [pairs[index] for index in indices]
            K = np.stack([self.camera(pair.scene_id, pair.im_id).K for pair in found])
            T_gt = np.stack([pair.truth.T_cam_obj for pair in found])
            for name, values in pose_errors(self.model(obj_id), _estimated(found), T_gt, K).items():
                columns[name][indices] = values
        return columns

    def _other_mssd_m(self, pairs: Sequence[Pair]) -> Float[Array, " n"]:
        """Smallest MSSD of each estimate to another true instance of its object in the image, NaN without."""
        result = np.full(len(pairs), np.inf)
        for obj_id, indices in _by_object(pairs):
            others = [
                (index, gt.T_cam_obj)
                for index in indices
                for gt in self.gt(pairs[index].scene_id, pairs[index].im_id)
                if gt.obj_id == obj_id and gt.has_pose and gt.gt_index != pairs[index].truth.gt_index
            ]
            if others:
                rows, T_other = [row for row, _ in others], np.stack([T for _, T in others])
                model = self.model(obj_id)
                T_est = _estimated([pairs[row] for row in rows])
                errors_m = metrics.mssd(T_est, T_other, model.hull_m, model.symmetries_of(T_est, T_other))
                np.minimum.at(result, rows, errors_m)
        return np.where(np.isfinite(result), result, np.nan)

    def _silhouettes(self, pairs: Sequence[Pair]) -> tuple[Float[Array, " n"], Float[Array, "n t"]]:
        """VSS of each pair, 0 where missing, and VSD for every tolerance, NaN where missing or without depth."""
        vss, vsd = np.zeros(len(pairs)), np.full((len(pairs), len(VSD_TAUS)), np.nan)
        self._render_truths(pairs)
        patches: dict[int, Patch] = {}
        for obj_id, indices in _by_object(pairs):
            poses = _estimated([pairs[index] for index in indices])
            patches |= zip(indices, self._render(obj_id, [pairs[index] for index in indices], poses), strict=True)
        for index in sorted(patches, key=lambda index: (pairs[index].scene_id, pairs[index].im_id)):
            vss[index], vsd[index] = self._compare(pairs[index], patches[index])
        self._forget_truths()
        return vss, vsd

    def _render_truths(self, pairs: Sequence[Pair]) -> None:
        missing: dict[int, dict[tuple[int, int, int], Pair]] = defaultdict(dict)
        for pair in pairs:
            if pair.estimate is None:
                continue
            if (key := _truth_key(pair)) in self._truths:
                self._truths.move_to_end(key)
            else:
                missing[pair.truth.obj_id][key] = pair
        for obj_id, fresh in missing.items():
            poses = np.stack([pair.truth.T_cam_obj for pair in fresh.values()])
            self._truths |= zip(fresh, self._render(obj_id, list(fresh.values()), poses), strict=True)

    def _forget_truths(self) -> None:
        """Keep the renders used last, as many as `KEPT_BYTES` hold."""
        size = sum(patch.depth_m.nbytes for patch in self._truths.values())
        while size > KEPT_BYTES:
            size -= self._truths.popitem(last=False)[1].depth_m.nbytes

    def _render(self, obj_id: int, pairs: Sequence[Pair], T_cam_obj: Float[Array, "b 4 4"]) -> list[Patch]:
        hull_m = self.model(obj_id).hull_m
        cameras = [self.camera(pair.scene_id, pair.im_id) for pair in pairs]
        return [
            silhouettes.render_patch(self.rasteriser, obj_id, hull_m, camera, pose)
            for camera, pose in zip(cameras, T_cam_obj, strict=True)
        ]

    def _compare(self, pair: Pair, patch: Patch) -> tuple[float, Float[Array, " t"]]:
        true, K = self._truths[_truth_key(pair)], self.camera(pair.scene_id, pair.im_id).K
        depth_m = self._depth_m(pair.scene_id, pair.im_id) if self._visible or self._with_vsd else None
        if self._visible and depth_m is None:
            scene = self.dataset.scene_path(pair.scene_id)
            raise DatasetError(
                f"{scene / 'depth'}: image {pair.im_id} has no depth, which --vss visible needs; use --vss full"
            )
        vsd = np.full(len(VSD_TAUS), np.nan)
        if self._with_vsd and depth_m is not None:
            taus_m = VSD_TAUS * self.dataset.models_info[pair.truth.obj_id].diameter_m
            vsd = silhouettes.vsd(patch, true, K, depth_m, taus_m)
        if self._visible and depth_m is not None:
            return silhouettes.vss_visible(patch, true, K, depth_m), vsd
        return silhouettes.vss_full(patch, true), vsd


def _estimated(pairs: Sequence[Pair]) -> Float[Array, "b 4 4"]:
    return np.stack([pair.estimate.T_cam_obj for pair in pairs if pair.estimate is not None])


def _truth_key(pair: Pair) -> tuple[int, int, int]:
    return pair.scene_id, pair.im_id, pair.truth.gt_index


def _by_object(pairs: Sequence[Pair]) -> Iterator[tuple[int, list[int]]]:
    """Objects with the places of the pairs that have an estimate of them."""
    indices: dict[int, list[int]] = defaultdict(list)
    for index, pair in enumerate(pairs):
        if pair.estimate is not None:
            indices[pair.truth.obj_id].append(index)
    yield from sorted(indices.items())
