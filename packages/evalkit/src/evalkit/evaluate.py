"""Dataset and result files to a table: one row for every expected pose, found or missing."""

from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Literal

import numpy as np
import pandas as pd
from jaxtyping import Float
from posecore.bop import BopDataset, Estimate, GroundTruth, symmetry_transforms
from posecore.camera import Camera
from posecore.errors import DatasetError
from posecore.mesh import Mesh
from posecore.raster import Rasteriser
from posecore.symmetry import align_ball, is_ball
from scipy.spatial import ConvexHull, QhullError

from evalkit import metrics, silhouette
from evalkit.files import load_result_files
from evalkit.pairing import Level, Pair, pair_up
from evalkit.scores.bop import AllErrors, with_bop19
from evalkit.scores.definitions import VSD_COLUMNS, VSD_TAUS
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

TRUTH_COLUMNS = (
    *("scene_id", "im_id", "obj_id", "gt_index", "visib_fract"),
    *("inst_count", "diameter_m", "image_width_px"),
)


def evaluate(dataset: str | Path, results: str | Path, *, vss: VssKind = "full", with_vsd: bool = True) -> pd.DataFrame:
    """Errors of the poses in a result file: one row for each expected pose, found or missing.

    `evalkit.scores.scores(table)` sums them up; `evalkit.table.COLUMNS` says what each column holds, with its unit.
    Beside those columns stand `vsd_0.05` ... `vsd_0.50` where images have depth (VSD at these tolerances in diameters,
    NaN for images without), and `bop19_mssd`, `bop19_mspd` and, where all images have depth, `bop19_vsd`: the share of
    BOP19's thresholds at which BOP's matching gives the instance an estimate. Files of perturbed starts have none.

    Args:
        dataset: folder in BOP format with ground truth.
        results: BOP result file (CSV), translations in millimetres.
        vss: whole silhouettes, or their visible parts, which needs depth images.
        with_vsd: whether VSD is computed where there is depth.

    Raises:
        PoseError: a file or the dataset is not usable; the message names it.
    """
    opened = BopDataset(dataset)
    (file,) = load_result_files([Path(results)], opened)
    with Evaluator(opened, vss, with_vsd=with_vsd) as evaluator:
        table = evaluator.evaluate(pair_up(opened, file).pairs)
        if "perturbation" in file.sidecar:
            return table
        return with_bop19(table, evaluator.all_errors(file.estimates))


@dataclass(frozen=True, kw_only=True, eq=False)
class _Model:
    mesh: Mesh
    hull_m: Float[Array, "h 3"]
    symmetries: Float[Array, "s 4 4"]


class Evaluator:
    """Scores pairs against one dataset; true silhouettes are rendered once for all result files."""

    def __init__(self, dataset: BopDataset, vss: VssKind = "full", *, with_vsd: bool = True) -> None:
        """Open a renderer for the dataset's models (`models_eval` where there is one).

        Args:
            dataset: with ground truth.
            vss: whole silhouettes, or their visible parts, which needs depth images.
            with_vsd: whether VSD is added where an image has depth, in columns `vsd_0.05` ... `vsd_0.50`.
        """
        self.dataset, self.vss, self.with_vsd = dataset, vss, with_vsd
        self._depth: tuple[tuple[int, int], Float[Array, "h w"] | None] | None = None
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
        values, vsd = self._silhouette_errors(pairs)
        rows = []
        for pair, value in zip(pairs, values, strict=True):
            rows.append(self._row(pair, value))
            advance(1)
        table = table_of(rows)
        if self.with_vsd and np.isfinite(vsd).any():
            table[list(VSD_COLUMNS)] = vsd
        return table

    def all_errors(self, estimates: Sequence[Estimate]) -> AllErrors:
        """Every estimate in the targets' images against every true instance of its object: what BOP19 and BOP24 match.

        Args:
            estimates: of a result file; those in other images are left out.
        """
        asked = {(t.scene_id, t.im_id, t.obj_id): t.inst_count for t in self.dataset.targets}
        images = list(dict.fromkeys(key[:2] for key in asked))
        truths = [
            (*image, gt) for image in images for gt in self.dataset.gt(*image) if gt.has_pose and gt.obj_id in self._ids
        ]
        kept = [estimate for estimate in estimates if (estimate.scene_id, estimate.im_id) in set(images)]
        places: dict[tuple[int, int, int], list[int]] = defaultdict(list)
        for place, (scene_id, im_id, gt) in enumerate(truths):
            places[scene_id, im_id, gt.obj_id].append(place)
        pairs, ends = [], []
        for index, estimate in enumerate(kept):
            for place in places.get((estimate.scene_id, estimate.im_id, estimate.obj_id), []):
                scene_id, im_id, gt = truths[place]
                pairs.append(Pair(scene_id=scene_id, im_id=im_id, truth=gt, estimate=estimate))
                ends.append((index, place))
        errors = self.evaluate(pairs)
        columns = ["mssd_m", "mspd_px", *(name for name in VSD_COLUMNS if name in errors)]
        errors = errors[columns].copy()
        if not errors.reindex(columns=list(VSD_COLUMNS)).notna().all(axis=None):
            errors = errors[["mssd_m", "mspd_px"]]  # images without depth: no recall of VSD
        errors.insert(0, "estimate", np.array([end[0] for end in ends], np.int64))
        errors.insert(1, "truth", np.array([end[1] for end in ends], np.int64))
        return AllErrors(
            estimates=pd.DataFrame(
                [(e.scene_id, e.im_id, e.obj_id, e.line, e.score) for e in kept],
                columns=["scene_id", "im_id", "obj_id", "line", "score"],
            ),
            truths=pd.DataFrame(
                [self._truth_row(scene_id, im_id, gt, asked) for scene_id, im_id, gt in truths],
                columns=list(TRUTH_COLUMNS),
            ),
            errors=errors,
        )

    def _truth_row(
        self, scene_id: int, im_id: int, gt: GroundTruth, asked: Mapping[tuple[int, int, int], int]
    ) -> tuple[Any, ...]:
        visible = np.nan if gt.visib_fract is None else gt.visib_fract
        count = asked.get((scene_id, im_id, gt.obj_id), 0)
        diameter_m = self.dataset.models_info[gt.obj_id].diameter_m
        width_px = self.camera(scene_id, im_id).width_px
        return scene_id, im_id, gt.obj_id, gt.gt_index, visible, count, diameter_m, width_px

    @property
    def _ids(self) -> set[int]:
        return set(self.dataset.models_info)

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

    def _silhouette_errors(self, pairs: Sequence[Pair]) -> tuple[list[float], Float[Array, "n t"]]:
        """VSS of each pair, 0 where missing, and VSD for every tolerance, NaN where missing or without depth."""
        self._render_truths(pairs)
        values, vsd = [0.0] * len(pairs), np.full((len(pairs), len(VSD_TAUS)), np.nan)
        patches_of: dict[int, Patch] = {}
        for obj_id, indices in _by_object(pairs, lambda pair: pair.estimate is not None):
            views = [self._view(pairs[index], estimated=True) for index in indices]
            patches = silhouette.render_patches(self.rasteriser, obj_id, self.mesh(obj_id), views)
            patches_of |= zip(indices, patches, strict=True)
        for index, patch in sorted(
            patches_of.items(), key=lambda item: (pairs[item[0]].scene_id, pairs[item[0]].im_id)
        ):
            values[index], vsd[index] = self._compare(pairs[index], patch)
        return values, vsd

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

    def _compare(self, pair: Pair, patch: Patch) -> tuple[float, Float[Array, " t"]]:
        true, K = self._true_patches[_truth_key(pair)], self.camera(pair.scene_id, pair.im_id).K
        vss = silhouette.vss_full(patch, true) if self.vss == "full" else np.nan
        depth_m = self._depth_m(pair.scene_id, pair.im_id) if self.vss == "visible" or self.with_vsd else None
        if depth_m is None:
            if self.vss == "full":
                return vss, np.full(len(VSD_TAUS), np.nan)
            scene = self.dataset.scene_path(pair.scene_id)
            raise DatasetError(
                f"{scene / 'depth'}: image {pair.im_id} has no depth, which --vss visible needs; use --vss full"
            )
        if self.vss == "visible":
            vss = silhouette.vss_visible(patch, true, K, depth_m)
        if not self.with_vsd:
            return vss, np.full(len(VSD_TAUS), np.nan)
        taus_m = VSD_TAUS * self.dataset.models_info[pair.truth.obj_id].diameter_m
        return vss, silhouette.vsd(patch, true, K, depth_m, taus_m)

    def _depth_m(self, scene_id: int, im_id: int) -> Float[Array, "h w"] | None:
        """Depth of an image; the last one is kept, as pairs come image by image."""
        if self._depth is None or self._depth[0] != (scene_id, im_id):
            self._depth = (scene_id, im_id), self.dataset.depth_m(scene_id, im_id)
        return self._depth[1]

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
