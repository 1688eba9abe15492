"""Dataset and result files to a table: one row for every expected pose, found or missing."""

from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from types import TracebackType
from typing import Any, Literal

import numpy as np
import pandas as pd
from jaxtyping import Float
from posecore.bop import BopDataset, GroundTruth, symmetry_transforms
from posecore.camera import Camera
from posecore.errors import DatasetError
from posecore.mesh import Mesh
from posecore.raster import Rasteriser
from posecore.symmetry import align_ball, is_ball
from scipy.spatial import ConvexHull, QhullError

from evalkit import metrics, silhouette
from evalkit.pairing import Level, Pair
from evalkit.silhouette import Patch, View
from evalkit.table import table_of

Array = np.ndarray
VssKind = Literal["full", "visible"]
Progress = Callable[[int], None]
ERRORS = (
    *("add_m", "adi_m", "mssd_m", "mspd_px", "proj_px", "proj_sym_px"),
    *("re_rad", "re_sym_rad", "te_m", "dx_m", "dy_m", "dz_m"),
)
"""Columns that are NaN where an estimate is missing."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Model:
    mesh: Mesh
    hull_m: Float[Array, "h 3"]
    symmetries: Float[Array, "s 4 4"]


class Evaluator:
    """Scores pairs against one dataset; true silhouettes are rendered once for all result files."""

    def __init__(self, dataset: BopDataset, vss: VssKind = "full") -> None:
        """Open a renderer for the dataset's models (`models_eval` where there is one).

        Args:
            dataset: with ground truth.
            vss: whole silhouettes, or their visible parts, which needs depth images.
        """
        self.dataset, self.vss = dataset, vss
        self.rasteriser = Rasteriser({})
        self._models: dict[int, _Model] = {}
        self._true_patches: dict[tuple[int, int, int], Patch] = {}
        self._cameras: dict[tuple[int, int], Camera] = {}

    def __enter__(self) -> "Evaluator":
        """Use in a with statement."""
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        """Free the renderer."""
        self.rasteriser.close()

    def evaluate(self, pairs: Sequence[Pair], advance: Progress = lambda done: None) -> pd.DataFrame:
        """Score pairs, in their order; `advance` is called with the number of pairs done since the last call.

        Raises:
            DatasetError: a model is missing, or VSS of visible parts is wanted and an image has no depth.
        """
        values = self._vss(pairs)
        rows = []
        for pair, value in zip(pairs, values, strict=True):
            rows.append(self._row(pair, value))
            advance(1)
        return table_of(rows)

    def camera(self, scene_id: int, im_id: int) -> Camera:
        """Intrinsics of an image, read once."""
        if (scene_id, im_id) not in self._cameras:
            self._cameras[scene_id, im_id] = self.dataset.camera(scene_id, im_id)
        return self._cameras[scene_id, im_id]

    def mesh(self, obj_id: int) -> Mesh:
        """The model that errors are measured on."""
        return self._model(obj_id).mesh

    def _model(self, obj_id: int) -> _Model:
        if obj_id not in self._models:
            if obj_id not in self.dataset.models_info:
                raise DatasetError(f"{self.dataset.root}: models_info.json has no object {obj_id}; add its diameter")
            mesh = self.dataset.mesh(obj_id, eval=True)
            self.rasteriser.add(obj_id, mesh)
            self._models[obj_id] = _Model(
                mesh=mesh,
                hull_m=_hull(mesh.vertices_m),
                symmetries=symmetry_transforms(self.dataset.models_info[obj_id]),
            )
        return self._models[obj_id]

    def _vss(self, pairs: Sequence[Pair]) -> list[float]:
        self._render_truths(pairs)
        values = [0.0] * len(pairs)
        for obj_id, indices in _by_object(pairs, lambda pair: pair.estimate is not None):
            views = [self._view(pairs[index], estimated=True) for index in indices]
            patches = silhouette.render_patches(self.rasteriser, obj_id, self.mesh(obj_id), views)
            for index, patch in zip(indices, patches, strict=True):
                values[index] = self._compare(pairs[index], patch)
        return values

    def _render_truths(self, pairs: Sequence[Pair]) -> None:
        fresh = {_truth_key(pair): pair for pair in pairs if _truth_key(pair) not in self._true_patches}
        missing = list(fresh.values())
        for obj_id, indices in _by_object(missing, lambda pair: True):
            views = [self._view(missing[index], estimated=False) for index in indices]
            patches = silhouette.render_patches(self.rasteriser, obj_id, self.mesh(obj_id), views)
            for index, patch in zip(indices, patches, strict=True):
                self._true_patches[_truth_key(missing[index])] = patch

    def _view(self, pair: Pair, *, estimated: bool) -> View:
        self._model(pair.truth.obj_id)
        pose = pair.estimate.T_cam_obj if estimated and pair.estimate is not None else pair.truth.T_cam_obj
        return View(camera=self.camera(pair.scene_id, pair.im_id), T_cam_obj=pose)

    def _compare(self, pair: Pair, patch: Patch) -> float:
        true = self._true_patches[_truth_key(pair)]
        if self.vss == "full":
            return silhouette.vss_full(patch, true)
        depth_m = self.dataset.depth_m(pair.scene_id, pair.im_id)
        if depth_m is None:
            scene = self.dataset.scene_path(pair.scene_id)
            raise DatasetError(
                f"{scene / 'depth'}: image {pair.im_id} has no depth, which --vss visible needs; use --vss full"
            )
        return silhouette.vss_visible(patch, true, self.camera(pair.scene_id, pair.im_id).K, depth_m)

    def _row(self, pair: Pair, vss: float) -> dict[str, Any]:
        truth, estimate = pair.truth, pair.estimate
        info = self.dataset.models_info[truth.obj_id]
        level = pair.level or Level(angle_deg=np.nan, translation_diameter=np.nan)
        camera = self.camera(pair.scene_id, pair.im_id)
        azimuth_deg, elevation_deg = metrics.viewpoint_deg(truth.T_cam_obj)
        return {
            "scene_id": pair.scene_id,
            "im_id": pair.im_id,
            "obj_id": truth.obj_id,
            "gt_index": truth.gt_index,
            "visib_fract": np.nan if truth.visib_fract is None else truth.visib_fract,
            "found": estimate is not None,
            "line": 0 if estimate is None else estimate.line,
            "score": np.nan if estimate is None else estimate.score,
            "time_s": np.nan if estimate is None else estimate.time_s,
            "start_angle_deg": level.angle_deg,
            "start_translation_diameter": level.translation_diameter,
            "diameter_m": info.diameter_m,
            "symmetric": info.is_symmetric,
            "image_width_px": camera.width_px,
            "distance_m": float(truth.T_cam_obj[2, 3]),
            "view_azimuth_deg": azimuth_deg,
            "view_elevation_deg": elevation_deg,
            "other_mssd_m": self._other_mssd_m(pair),
            "vss": vss,
            **(dict.fromkeys(ERRORS, np.nan) if estimate is None else self._errors(estimate.T_cam_obj, truth, camera)),
        }

    def _other_mssd_m(self, pair: Pair) -> float:
        """Smallest MSSD to another true instance of the object in the image."""
        truth, estimate = pair.truth, pair.estimate
        if estimate is None:
            return np.nan
        others = [
            gt
            for gt in self.dataset.gt(pair.scene_id, pair.im_id)
            if gt.obj_id == truth.obj_id and gt.has_pose and gt.gt_index != truth.gt_index
        ]
        model = self._model(truth.obj_id)
        return min(
            (metrics.mssd(estimate.T_cam_obj, gt.T_cam_obj, model.hull_m, model.symmetries) for gt in others),
            default=np.nan,
        )

    def _errors(self, T_est: Float[Array, "4 4"], truth: GroundTruth, camera: Camera) -> dict[str, float]:
        T_gt, model = truth.T_cam_obj, self._model(truth.obj_id)
        points_m, symmetries = model.mesh.vertices_m, model.symmetries
        continuous = self.dataset.models_info[truth.obj_id].symmetries_continuous
        if is_ball(continuous):
            symmetries = np.stack([np.eye(4), align_ball(continuous, T_gt, T_est)])
        mspd_px, proj_px, proj_sym_px = metrics.projection_errors(T_est, T_gt, camera.K, points_m, symmetries)
        dx_m, dy_m, dz_m = (float(value) for value in metrics.te_axes(T_est, T_gt))
        return {
            "add_m": metrics.add(T_est, T_gt, points_m),
            "adi_m": metrics.adi(T_est, T_gt, points_m),
            "mssd_m": metrics.mssd(T_est, T_gt, model.hull_m, symmetries),
            "mspd_px": mspd_px,
            "proj_px": proj_px,
            "proj_sym_px": proj_sym_px,
            "re_rad": metrics.re(T_est, T_gt),
            "re_sym_rad": metrics.re_symmetric(T_est, T_gt, symmetries),
            "te_m": metrics.te(T_est, T_gt),
            "dx_m": dx_m,
            "dy_m": dy_m,
            "dz_m": dz_m,
        }


def _truth_key(pair: Pair) -> tuple[int, int, int]:
    return pair.scene_id, pair.im_id, pair.truth.gt_index


def _by_object(pairs: Sequence[Pair], wanted: Callable[[Pair], bool]) -> Iterator[tuple[int, list[int]]]:
    indices: dict[int, list[int]] = defaultdict(list)
    for index, pair in enumerate(pairs):
        if wanted(pair):
            indices[pair.truth.obj_id].append(index)
    yield from sorted(indices.items())


def _hull(points_m: Float[Array, "n 3"]) -> Float[Array, "h 3"]:
    try:
        return np.asarray(points_m[ConvexHull(points_m).vertices])
    except QhullError:  # a flat model has no hull: all its points are kept
        return points_m
