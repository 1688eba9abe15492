"""Search for the pose whose edges run as the image's do, around a start that may be far off; then edge ICP.

How well the gradient orientations of render and image agree tells the true pose from others sharply: so sharply that
nothing leads there from afar. So poses are drawn around the start, drawn again around the best of them, ever closer,
while an edge of the image counts from less and less far away. These spread orientations are those of LINE-2D
(Hinterstoisser et al., PAMI 2012), in response maps made once for all poses; the draws are an evolution strategy.
"""

import zlib
from collections.abc import Mapping
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from posecore import se3
from posecore.mesh import Mesh
from posecore.raster import Rasteriser
from posecore.simplify import simplified

from refinenet.agreement import RENDER_EDGE, SCENE_EDGE, gradient_agreement, gradients, render_gradients
from refinenet.baselines.edge_icp import refine_by_edges
from refinenet.baselines.outcome import Baseline, failed
from refinenet.baselines.view import Target, View, look
from refinenet.methods import Frame, Refinement, Status

Array = np.ndarray
ORIENTATIONS = 16
"""Bins of half a turn. Like all below: chosen on renders."""
MAX_FACES = 64**2
MIN_EDGE_PX = 20
"""A render with fewer edge pixels than this is judged as if it had so many."""
MIN_AGREEMENT = 0.1
"""Of gradients in the end, below which nothing was found."""
ENOUGH_AGREEMENT = 0.55
"""Below this the search is made again, with other draws. Most rendered poses that end above it are right, few below."""
TRIES = 3


@dataclass(frozen=True, kw_only=True)
class Stage:
    """A search at one resolution.

    Attributes:
        patch_px: Side of the patch.
        spread_px: From how far away an edge of the image counts, round by round.
        drawn: Poses drawn in a round; twice as many in the first.
        kept: The best, which the next round draws around.
        angle_rad: Standard deviation of the first round's turns about each axis.
        shift: That of moves across the image, in diameters.
        stretch: That of the logarithm of the depth.
        shrink: Factor on the three from round to round.
        leash: Agreement that a pose must gain to go a standard deviation further from the start, squared.
    """

    patch_px: int
    spread_px: tuple[int, ...]
    drawn: int
    kept: int
    angle_rad: float
    shift: float
    stretch: float
    shrink: float
    leash: float


STAGES = (
    Stage(
        patch_px=64, spread_px=(4, 4, 3, 3, 2, 2, 1, 1, 0, 0), drawn=80, kept=10,
        angle_rad=0.5, shift=0.12, stretch=0.08, shrink=0.72, leash=0.008,
    ),
    Stage(
        patch_px=112, spread_px=(2, 2, 1, 1, 0, 0), drawn=48, kept=8,
        angle_rad=0.15, shift=0.03, stretch=0.04, shrink=0.7, leash=0.0,
    ),
)  # fmt: skip


class GradientSearch(Baseline):
    """`--method search`. Draws depend on the start pose alone.

    Args:
        meshes: Objects by id.
        iterations: Of the edge ICP in the end.
    """

    name = "search"

    def __init__(self, meshes: Mapping[int, Mesh], *, iterations: int = 5) -> None:
        super().__init__(meshes, iterations=iterations)
        self._quick = Rasteriser({obj_id: simplified(mesh, MAX_FACES) for obj_id, mesh in meshes.items()})

    def close(self) -> None:
        """Free what the renderers hold."""
        self._quick.close()
        super().close()

    def _refine(self, frame: Frame, T_cam_obj: Float[Array, "4 4"], target: Target) -> Refinement:
        start = np.ascontiguousarray(T_cam_obj, np.float64)
        rng = np.random.default_rng([target.obj_id, zlib.crc32(start.tobytes())])
        if look(frame.image, frame.K, start, target, STAGES[0].patch_px) is None:
            return failed(T_cam_obj, 0, "the start pose shows nothing of the object in the image")
        best, done = failed(T_cam_obj, 0, ""), 0
        for _ in range(TRIES):
            found = self._try(frame, start, target, rng)
            done += found.iterations
            best = max(best, found, key=_confidence)
            if _confidence(best) >= ENOUGH_AGREEMENT:
                break
        if _confidence(best) < MIN_AGREEMENT:
            why = f"gradients agree with the image's by {_confidence(best):.2f} at most, {MIN_AGREEMENT} needed"
            return failed(T_cam_obj, done, why)
        return replace(best, iterations=done)

    def _try(self, frame: Frame, start: Float[Array, "4 4"], target: Target, rng: np.random.Generator) -> Refinement:
        """What one search finds."""
        pose, rounds = start, 0
        for stage in STAGES:
            view = look(frame.image, frame.K, pose, target, stage.patch_px)
            if view is None:  # the stage before went astray, which its agreement will tell
                break
            pose = search(view, pose, target, self._quick, stage, rng)
            rounds += len(stage.spread_px)
        by_edges = refine_by_edges(frame.image, frame.K, pose, target, self.iterations)
        agreement, at_edges = (_agreement(frame, T, target) for T in (pose, by_edges.T_cam_obj))
        status = Status.STOPPED
        if not by_edges.failed and at_edges >= agreement:
            pose, agreement, status = by_edges.T_cam_obj, at_edges, by_edges.status
        done = rounds + by_edges.iterations
        return Refinement(T_cam_obj=pose, status=status, iterations=done, confidence=agreement)


def _confidence(found: Refinement) -> float:
    return found.confidence or 0.0


def _agreement(frame: Frame, T_cam_obj: Float[Array, "4 4"], target: Target) -> float:
    """How well a pose fits in the end, in [0, 1]; 0 where nothing of it is to be seen."""
    view = look(frame.image, frame.K, T_cam_obj, target, STAGES[-1].patch_px)
    if view is None:
        return 0.0
    return float(gradient_agreement(view.scene_rgb[None], view.rgb[None], view.mask[None], view.in_image[None])[0])


def search(
    view: View,
    start: Float[Array, "4 4"],
    target: Target,
    rasteriser: Rasteriser,
    stage: Stage,
    rng: np.random.Generator,
) -> Float[Array, "4 4"]:
    """The best pose of a stage.

    Args:
        view: The start, looked at.
        start: Start pose, metres.
        target: Object.
        rasteriser: Draws it.
        stage: How to search.
        rng: Source of every draw.
    """
    responses = {spread: response_maps(view, spread) for spread in set(stage.spread_px)}
    sigma = np.array([stage.angle_rad] * 3 + [stage.shift] * 2 + [stage.stretch])
    best = np.zeros((1, 6))
    for number, spread in enumerate(stage.spread_px):
        drawn = stage.drawn * (2 if number == 0 else 1)
        around = best[rng.integers(len(best), size=drawn)]
        moves = np.concatenate([best, around + rng.normal(size=(drawn, 6)) * sigma * stage.shrink**number])
        T = moved_by(start, moves, target.mesh)
        layers = rasteriser.render(target.obj_id, view.K, T, stage.patch_px, stage.patch_px)
        assert layers.rgb is not None
        agreement = edge_agreement(layers.rgb, layers.mask, view.in_image, responses[spread])
        score = agreement - stage.leash * np.square(moves / sigma).sum(axis=1)
        best = moves[np.argsort(-score, kind="stable")[: stage.kept]]
    return np.asarray(moved_by(start, best[:1], target.mesh)[0])


def moved_by(start: Float[Array, "4 4"], moves: Float[Array, "n 6"], mesh: Mesh) -> Float[Array, "n 4 4"]:
    """Poses turned in camera axes about the mesh's centre, moved across the image (diameters) and in depth (log)."""
    centre_m = start[:3, :3] @ mesh.center_m + start[:3, 3]
    across_m = np.pad(mesh.diameter_m * moves[:, 3:5], ((0, 0), (0, 1)))
    R = se3.rotation_from_rotvec(moves[:, :3]) @ start[:3, :3]
    t = np.exp(moves[:, 5:]) * (centre_m + across_m) - R @ mesh.center_m
    return se3.make_T(R, t)


def response_maps(view: View, spread_px: int) -> Float[Array, "o p p"]:
    """For each orientation of an edge, how well the image's edges within `spread_px` agree with it, in [0, 1]."""
    unit, strength = gradients(view.scene_rgb[None].astype(np.float32))
    doubled = _doubled(unit[0]) * ((strength[0] > SCENE_EDGE) & view.in_image)[..., None]
    angle_rad = 2 * np.pi * np.arange(ORIENTATIONS) / ORIENTATIONS
    maps = np.tensordot(np.stack([np.cos(angle_rad), np.sin(angle_rad)], axis=1), doubled, axes=(1, 2))
    maps = np.maximum(maps, 0).astype(np.float32)
    if spread_px:
        disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * spread_px + 1,) * 2)
        maps = np.stack([cv2.dilate(one, disc) for one in maps])
    return np.asarray(maps)


def edge_agreement(
    rgb: UInt8[Array, "n p p 3"],
    mask: Bool[Array, "n p p"],
    in_image: Bool[Array, "p p"],
    responses: Float[Array, "o p p"],
) -> Float[Array, " n"]:
    """Mean response at the edges of renders, silhouettes included."""
    unit, strength = render_gradients(rgb, mask)
    n, row, column = np.nonzero((strength > RENDER_EDGE) & in_image)
    doubled = _doubled(unit[n, row, column])
    turn = np.arctan2(doubled[:, 1], doubled[:, 0]) / (2 * np.pi)
    orientation: Int[Array, " e"] = np.rint(turn * ORIENTATIONS).astype(np.int64) % ORIENTATIONS
    total = np.bincount(n, weights=responses[orientation, row, column], minlength=len(rgb))
    return np.asarray(total / np.maximum(np.bincount(n, minlength=len(rgb)), MIN_EDGE_PX))


def _doubled(unit: Float[Array, "*n 2"]) -> Float[Array, "*n 2"]:
    """Directions of doubled angle: opposite gradients have the same."""
    x, y = unit[..., 0], unit[..., 1]
    return np.stack([x * x - y * y, 2 * x * y], axis=-1)
