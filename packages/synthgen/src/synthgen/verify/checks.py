"""The checks of single samples: one list, which the command, the page and the documentation read.

A check measures how far each sample is off; a sample passes at or below the tolerance. NaN never passes.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float
from posecore import se3
from posecore.camera import crop_K, project
from posecore.contour import distance_transform_px
from posecore.shard import BIT_FOREGROUND, BIT_OBJECT, BIT_VISIBLE
from posecore.window import Window, diameter_window, fixed_window

from synthgen.image.region import inside_image
from synthgen.pairs.pair_maker import MAX_ATTEMPTS, MAX_HYPOTHESIS_ATTEMPTS
from synthgen.verify.facts import Batch

Array = np.ndarray
Measure = Callable[[Batch], Float[Array, " n"]]

_RIM = np.ones((5, 5), np.uint8)
_FREE_PX = 2
_VERTICES = 2000  # of each object that are projected


@dataclass(frozen=True, kw_only=True, eq=False)
class Check:
    """One thing that is true of every sample of a sound dataset.

    Attributes:
        name: Short name, as reported.
        what: One sentence.
        tolerance: Largest measure that passes.
        unit: Of measure and tolerance.
        why: Reason for the tolerance.
        drawn: Whether only the drawn samples are looked at, because it costs milliseconds.
        rendered: Whether it holds of rendered pairs alone, whose recipe says where poses may lie.
        measure: How far each sample is off.
    """

    name: str
    what: str
    tolerance: float
    unit: str
    why: str
    drawn: bool
    rendered: bool
    measure: Measure


CHECKS: list[Check] = []
"""Every check of a sample, in the order in which they are reported."""


def _check(
    name: str, tolerance: float, unit: str, why: str, *, drawn: bool = False, rendered: bool = False
) -> Callable[[Measure], Measure]:
    def register(measure: Measure) -> Measure:
        what = " ".join((measure.__doc__ or "").split())
        CHECKS.append(
            Check(
                name=name,
                what=what,
                tolerance=tolerance,
                unit=unit,
                why=why,
                drawn=drawn,
                rendered=rendered,
                measure=measure,
            )
        )
        return measure

    return register


# ------------------------------------------------------------------ numbers


@_check("finite", 0, "values", "NaN and infinity mean nothing in any field")
def finite(batch: Batch) -> Float[Array, " n"]:
    """No field holds NaN or infinity."""
    bad = np.zeros(len(batch))
    for values in batch.values.values():
        if values.dtype.kind == "f":
            bad += (~np.isfinite(values)).reshape(len(batch), -1).sum(axis=1)
    return bad


@_check("poses", 1e-9, "1", "poses are stored in float64 as they were drawn; products of rotations lose 1e-15")
def poses(batch: Batch) -> Float[Array, " n"]:
    """Both poses are rigid: R R^T = I, det R = +1, last row 0 0 0 1."""
    worst = np.zeros(len(batch))
    for name in ("T_cam_obj", "T_cam_obj_hypothesis"):
        T = batch[name]
        R = T[:, :3, :3]
        residual = np.abs(R @ np.swapaxes(R, 1, 2) - np.eye(3)).max(axis=(1, 2))
        residual = np.maximum(residual, np.abs(np.linalg.det(R) - 1.0))
        worst = np.maximum(worst, np.maximum(residual, np.abs(T[:, 3] - np.array([0.0, 0.0, 0.0, 1.0])).max(axis=1)))
    return worst


@_check("camera", 1e-6, "px", "float64 throughout; the card's numbers are the ones that were used")
def camera(batch: Batch) -> Float[Array, " n"]:
    """K is the card's camera where all images have one, and K_crop is K cut to window_px."""
    K, windows = batch["K"], batch["window_px"]
    shared = batch.facts.card["camera"].get("shared", True)
    worst = np.abs(K - batch.facts.camera.K).max(axis=(1, 2)) * shared
    for i in range(len(batch)):
        if windows[i, 2] > 0:
            expected = crop_K(K[i], _window(windows[i]), batch.facts.patch_px)
            worst[i] = max(worst[i], np.abs(batch["K_crop"][i] - expected).max())
        else:
            worst[i] = np.inf
    return np.asarray(worst)


@_check("object", 0, "flag", "an object id is an integer")
def known_object(batch: Batch) -> Float[Array, " n"]:
    """obj_id is an object of the data card."""
    return np.array([float(i not in batch.facts.meshes) for i in batch["obj_id"].tolist()])


@_check("window", 1e-3, "px", "the box is projected from models/, whose millimetres are float32")
def window(batch: Batch) -> Float[Array, " n"]:
    """The window has its object's fixed side and is centred on the hypothesis' box, or follows its distance."""
    side_px = batch.facts.of_objects(batch["obj_id"], "window_side_px")
    scale = batch.facts.diameter_scale
    off = np.full(len(batch), np.inf)
    for i, obj_id in enumerate(batch["obj_id"].tolist()):
        if obj_id in batch.facts.meshes:
            T = batch["T_cam_obj_hypothesis"][i]
            mesh, K = batch.facts.meshes[obj_id], batch["K"][i]
            expected = (
                fixed_window(batch.facts.hulls_m[obj_id], K, T, side_px[i])
                if scale is None
                else diameter_window(K, T, mesh.center_m, mesh.diameter_m, scale)
            )
            off[i] = np.abs(batch["window_px"][i] - expected.as_array()).max()
    return off


@_check(
    "distance", 1e-6, "diameters", "the box centre comes from models/, whose millimetres are float32", rendered=True
)
def distance(batch: Batch) -> Float[Array, " n"]:
    """Camera z of the box centre at the truth lies in the configured range."""
    distance = batch.facts.card["config"]["distance"]
    diameter_m = batch.facts.of_objects(batch["obj_id"], "diameter_m")
    scale = diameter_m if distance["unit"] == "diameter" else np.ones(len(batch))
    z = centres_cam_m(batch, "T_cam_obj")[:, 2]
    return np.maximum(distance["min"] * scale - z, z - distance["max"] * scale).clip(0) / diameter_m


@_check("angle", 1e-6, "deg", "float64 throughout; the angle of two rotations is exact to 1e-8 rad", rendered=True)
def angle(batch: Batch) -> Float[Array, " n"]:
    """The hypothesis is turned against the truth by no more than perturbation.max_angle_deg."""
    limit = batch.facts.card["config"]["perturbation"]["max_angle_deg"]
    return (perturbation_deg(batch) - limit).clip(0)


@_check(
    "translation", 1e-6, "diameters", "the box centre comes from models/, whose millimetres are float32", rendered=True
)
def translation(batch: Batch) -> Float[Array, " n"]:
    """The box centre, about which the hypothesis is turned, moves by at most perturbation.max_translation_diameter."""
    limit = batch.facts.card["config"]["perturbation"]["max_translation_diameter"]
    return (moved_diameters(batch) - limit).clip(0)


@_check("scene", 0, "flag", "poses of one scene are copies of one another", rendered=True)
def scene(batch: Batch) -> Float[Array, " n"]:
    """scene_index is the sample's index over the hypotheses per scene; its samples share object and true pose."""
    per_scene = batch.facts.hypotheses_per_scene
    wrong = batch["scene_index"] != batch.indices // per_scene
    first = np.searchsorted(batch.indices, batch.indices - batch.indices % per_scene)
    same = (batch["T_cam_obj"] == batch["T_cam_obj"][first]).all(axis=(1, 2))
    return np.asarray(wrong | ~same | (batch["obj_id"] != batch["obj_id"][first])).astype(np.float64)


@_check("rejected", 0, "flag", "more draws than the sampler makes cannot have been rejected")
def rejected(batch: Batch) -> Float[Array, " n"]:
    """The number of rejected draws is one that the sampler can reach."""
    count = batch["rejected"]
    return np.asarray((count < 0) | (count > MAX_ATTEMPTS + MAX_HYPOTHESIS_ATTEMPTS)).astype(np.float64)


# ------------------------------------------------------------------ patches


@_check("scene patch", 0, "flag", "sensor noise alone makes more than half a grey level")
def scene_patch(batch: Batch) -> Float[Array, " n"]:
    """The scene patch is not blank: its grey levels differ by more than 0.5 (standard deviation)."""
    flat = batch["scene_rgb"].reshape(len(batch), -1)
    return np.array([float(cv2.meanStdDev(row)[1].item() <= 0.5) for row in flat])


@_check("hypothesis patch", 0, "pixels", "the silhouette is the render's own; 2 px more where an engine anti-aliases")
def hypothesis_patch(batch: Batch) -> Float[Array, " n"]:
    """The hypothesis patch shows something inside its silhouette and is black outside."""
    exact = not batch.facts.rendered or batch.facts.card["config"]["hypothesis_engine"] == "raster"
    off = np.zeros(len(batch))
    for i, (rgb, mask) in enumerate(zip(batch["hypothesis_rgb"], batch.hypothesis_mask, strict=True)):
        lit = rgb.any(axis=-1)
        wide = mask if exact else cv2.dilate(mask.astype(np.uint8), _RIM) > 0
        off[i] = (lit & ~wide).sum() if (lit & mask).any() else np.inf
    return off


@_check("mask", 0, "pixels", "bits are exact")
def mask(batch: Batch) -> Float[Array, " n"]:
    """Visible pixels are object and foreground, foreground has depth and nothing else has, no bit is unknown."""
    bits, depth = batch["scene_mask"], batch["scene_depth_m"] > 0
    seen, whole, front = bits & BIT_VISIBLE > 0, bits & BIT_OBJECT > 0, bits & BIT_FOREGROUND > 0
    wrong = (seen & ~whole) | (seen & ~front) | (front != depth) | (bits > BIT_OBJECT + BIT_VISIBLE + BIT_FOREGROUND)
    return np.asarray(wrong.sum(axis=(1, 2)), np.float64)


@_check("outside", 0, "pixels", "whether a patch pixel's centre lies in the image is exact")
def outside(batch: Batch) -> Float[Array, " n"]:
    """Nothing is visible outside the camera's image, where the scene patch is black but for its outermost pixels."""
    off = np.zeros(len(batch))
    for i, values in enumerate(batch["window_px"]):
        if not (np.isfinite(values).all() and values[2] > 0):
            off[i] = np.inf
            continue
        outer = ~inside_image(_window(values), batch.facts.patch_px, batch.facts.camera)
        if outer.any():
            off[i] = (outer & (batch["scene_mask"][i] & (BIT_VISIBLE | BIT_FOREGROUND) > 0)).sum()
            reach_px = max(2, math.ceil(0.5 * batch.facts.patch_px / values[2]) + 1)  # half an image pixel, enlarged
            rim = np.ones((2 * reach_px + 1, 2 * reach_px + 1), np.uint8)
            far = cv2.erode(outer.astype(np.uint8), rim, borderType=cv2.BORDER_REPLICATE) > 0
            off[i] += (far & batch["scene_rgb"][i].any(axis=-1)).sum()
    return off


@_check("visible fraction", 1e-6, "1", "one division of whole numbers, stored in float32")
def visible_fraction(batch: Batch) -> Float[Array, " n"]:
    """visible_fraction is the mask's visible pixels over its object pixels."""
    seen = (batch["scene_mask"] & BIT_VISIBLE > 0).sum(axis=(1, 2))
    whole = batch.object_mask.sum(axis=(1, 2))
    return np.abs(batch["visible_fraction"] - np.divide(seen, whole, out=np.full(len(batch), np.nan), where=whole > 0))


# ------------------------------------------------------------------ contours and distances


@_check("distance zeros", 0, "pixels", "a distance between two pixel centres is 0 or at least 1")
def distance_zeros(batch: Batch) -> Float[Array, " n"]:
    """Both distance transforms are zero on the silhouette's contour and nowhere else."""
    wrong = (batch["scene_distance_px"] == 0) != batch.scene_contour
    wrong_hypothesis = (batch["hypothesis_distance_px"] == 0) != batch.hypothesis_contour
    return np.asarray((wrong.sum(axis=(1, 2)) + wrong_hypothesis.sum(axis=(1, 2))), np.float64)


@_check("contour pixels", 0.01, "px", "points are contour pixels' centres; float32 metres project back within 1e-4 px")
def contour_pixels(batch: Batch) -> Float[Array, " n"]:
    """Every contour point projects to the centre of a contour pixel."""
    off = _off_contour_px(batch, "scene_contour_cam_m", batch.scene_contour)
    return np.maximum(off, _off_contour_px(batch, "hypothesis_contour_cam_m", batch.hypothesis_contour))


@_check("contour depth", 0.55, "depth steps", "depth is rounded to the nearest step; float32 adds 0.01 at most")
def contour_depth(batch: Batch) -> Float[Array, " n"]:
    """Contour points have the stored depth of their pixels: all of the hypothesis, the visible ones of the scene."""
    visible = batch["scene_mask"] & BIT_VISIBLE > 0
    off = _off_depth_m(batch, "scene_contour_cam_m", batch["scene_depth_m"], visible).max(axis=1)
    every = _off_depth_m(batch, "hypothesis_contour_cam_m", batch["hypothesis_depth_m"], batch.hypothesis_mask)
    return np.maximum(off, every.max(axis=1)) / batch.facts.step("hypothesis_depth_m")


@_check("distance values", 0, "px^2", "squared distances of pixel centres are whole numbers", drawn=True)
def distance_values(batch: Batch) -> Float[Array, " n"]:
    """Both distance transforms equal the ones computed again from the stored silhouettes."""
    off = np.zeros(len(batch))
    for name, contours in (
        ("scene_distance_px", batch.scene_contour),
        ("hypothesis_distance_px", batch.hypothesis_contour),
    ):
        for i, contour in enumerate(contours):
            if contour.any():
                expected = np.rint(np.square(distance_transform_px(contour)))
                off[i] = max(off[i], float(np.abs(np.rint(np.square(batch[name][i])) - expected).max()))
            else:
                off[i] = np.inf
    return off


# ------------------------------------------------------------------ the mesh, projected and drawn again


@_check("vertices", 0.02, "share of vertices", "parts thinner than a pixel may leave none", drawn=True)
def vertices(batch: Batch) -> Float[Array, " n"]:
    """The mesh's vertices, projected without a renderer, fall into both silhouettes, within 2 pixels."""
    off = np.full(len(batch), np.inf)
    for i, obj_id in enumerate(batch["obj_id"].tolist()):
        if obj_id not in batch.facts.meshes:
            continue
        mesh = batch.facts.meshes[obj_id]
        used = np.unique(mesh.faces)
        points = mesh.vertices_m[used[:: max(1, len(used) // _VERTICES)]]
        K = batch["K_crop"][i]
        truth = _stray(points, batch["T_cam_obj"][i], K, batch.object_mask[i])
        off[i] = max(truth, _stray(points, batch["T_cam_obj_hypothesis"][i], K, batch.hypothesis_mask[i]))
    return off


_OTHER_GL = "2 pixels are free: what an edge covers depends on the GL driver, and on the tile that is drawn in"


@_check("truth drawn again", 0.05, "of the contour", _OTHER_GL, drawn=True)
def truth_silhouette(batch: Batch) -> Float[Array, " n"]:
    """The object's mask bit is the silhouette of the mesh drawn at the true pose (differing over contour pixels)."""
    return _differing(batch.object_mask, batch.truth_drawn_m > 0, batch.scene_contour)


@_check("hypothesis drawn again", 0.05, "of the contour", _OTHER_GL, drawn=True)
def hypothesis_silhouette(batch: Batch) -> Float[Array, " n"]:
    """The hypothesis' depth has the silhouette of the mesh drawn at the hypothesis."""
    return _differing(batch.hypothesis_mask, batch.hypothesis_drawn_m > 0, batch.hypothesis_contour)


@_check("scene depth drawn again", 0.01, "share of pixels", _OTHER_GL, drawn=True)
def scene_depth(batch: Batch) -> Float[Array, " n"]:
    """Where the object is visible, scene depth is the drawn depth within one step."""
    visible = (batch["scene_mask"] & BIT_VISIBLE > 0) & (batch.truth_drawn_m > 0)
    return _unequal(batch, "scene_depth_m", batch.truth_drawn_m, visible)


@_check("hypothesis depth drawn again", 0.01, "share of pixels", _OTHER_GL, drawn=True)
def hypothesis_depth(batch: Batch) -> Float[Array, " n"]:
    """Hypothesis depth is the drawn depth within one step."""
    both = batch.hypothesis_mask & (batch.hypothesis_drawn_m > 0)
    return _unequal(batch, "hypothesis_depth_m", batch.hypothesis_drawn_m, both)


@_check("contour on surface", 0.1, "share of points", _OTHER_GL, drawn=True)
def contour_on_surface(batch: Batch) -> Float[Array, " n"]:
    """Contour points lie on the drawn surface within one depth step, hidden ones too."""
    limit_m = 1.01 * batch.facts.step("hypothesis_depth_m")
    shares = []
    for name, drawn in (
        ("scene_contour_cam_m", batch.truth_drawn_m),
        ("hypothesis_contour_cam_m", batch.hypothesis_drawn_m),
    ):
        shares.append((_off_depth_m(batch, name, drawn, np.ones_like(drawn, bool)) > limit_m).mean(axis=1))
    return np.maximum(*shares)


# ------------------------------------------------------------------ parts


def centres_cam_m(batch: Batch, pose: str) -> Float[Array, "n 3"]:
    """Box centres of the objects in the camera frame at a pose; NaN for unknown objects."""
    T = batch[pose]
    return np.einsum("nij,nj->ni", T[:, :3, :3], batch.facts.centres_m(batch["obj_id"])) + T[:, :3, 3]


def perturbation_deg(batch: Batch) -> Float[Array, " n"]:
    """Angle between truth and hypothesis."""
    turn = batch["T_cam_obj_hypothesis"][:, :3, :3] @ np.swapaxes(batch["T_cam_obj"][:, :3, :3], 1, 2)
    return np.rad2deg(se3.rotation_angle_rad(turn))


def moved_diameters(batch: Batch) -> Float[Array, " n"]:
    """Distance between the box centres at truth and hypothesis."""
    moved = centres_cam_m(batch, "T_cam_obj_hypothesis") - centres_cam_m(batch, "T_cam_obj")
    return np.linalg.norm(moved, axis=1) / batch.facts.of_objects(batch["obj_id"], "diameter_m")


def _window(values: Float[Array, "3"]) -> Window:
    return Window(x0_px=float(values[0]), y0_px=float(values[1]), side_px=float(values[2]))


def _pixels(batch: Batch, name: str) -> tuple[Array, Array, Array]:
    """Row and column of each contour point's pixel, clipped to the patch, and the projection."""
    uv = project(batch["K_crop"], batch[name].astype(np.float64))
    inside = np.nan_to_num(np.floor(uv), nan=-1).clip(0, batch.facts.patch_px - 1).astype(int)
    return inside[..., 1], inside[..., 0], uv


def _off_contour_px(batch: Batch, name: str, contour: Bool[Array, "n p p"]) -> Float[Array, " n"]:
    row, column, uv = _pixels(batch, name)
    off = np.maximum(np.abs(uv[..., 0] - column - 0.5), np.abs(uv[..., 1] - row - 0.5))
    hit = contour[np.arange(len(batch))[:, None], row, column]
    return np.asarray(np.where(hit & np.isfinite(off), off, np.inf).max(axis=1))


def _off_depth_m(
    batch: Batch, name: str, depth_m: Float[Array, "n p p"], where: Bool[Array, "n p p"]
) -> Float[Array, "n c"]:
    row, column, _ = _pixels(batch, name)
    at = (np.arange(len(batch))[:, None], row, column)
    return np.where(where[at], np.abs(batch[name][..., 2].astype(np.float64) - depth_m[at]), 0.0)


def _stray(
    points_m: Float[Array, "v 3"], T_cam_obj: Float[Array, "4 4"], K: Float[Array, "3 3"], mask: Bool[Array, "p p"]
) -> float:
    """Share of vertices that project into the patch but outside the silhouette."""
    uv = np.nan_to_num(np.floor(project(K, se3.apply(T_cam_obj, points_m))), nan=-1, posinf=-1, neginf=-1)
    inside = ((uv >= 0) & (uv < len(mask))).all(axis=1)
    column, row = uv.clip(0, len(mask) - 1).astype(int).T
    return float((inside & (cv2.dilate(mask.astype(np.uint8), _RIM) == 0)[row, column]).mean())


def _differing(
    stored: Bool[Array, "n p p"], drawn: Bool[Array, "n p p"], contour: Bool[Array, "n p p"]
) -> Float[Array, " n"]:
    return ((stored != drawn).sum(axis=(1, 2)) - _FREE_PX).clip(0) / contour.sum(axis=(1, 2)).clip(1)


def _unequal(
    batch: Batch, name: str, drawn_m: Float[Array, "n p p"], where: Bool[Array, "n p p"]
) -> Float[Array, " n"]:
    unequal = where & (np.abs(batch[name] - drawn_m) > 1.01 * batch.facts.step(name))
    return (unequal.sum(axis=(1, 2)) - _FREE_PX).clip(0) / where.sum(axis=(1, 2)).clip(1)
