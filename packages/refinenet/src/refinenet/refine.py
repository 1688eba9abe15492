"""Iterative refinement: render the hypothesis, cut both patches, predict, update, until the update is small."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from posecore import se3
from posecore.camera import crop_K
from posecore.errors import CheckpointError
from posecore.mesh import Mesh
from posecore.raster import Rasteriser
from posecore.window import Window, cut, diameter_window, fixed_window

from refinenet import checkpoint
from refinenet.checkpoint import Checkpoint
from refinenet.device import choose_device
from refinenet.network import Pair

Array = np.ndarray
STOP_ANGLE_DEG = 1.5
STOP_DISTANCE_M = 7.5e-3
DIAMETER_TOLERANCE = 0.02


@dataclass(frozen=True, kw_only=True, eq=False)
class Refinement:
    """Refined poses.

    Attributes:
        T_cam_obj: (b, 4, 4) metres; the start pose where refinement failed.
        converged: (b,) the last update was under the stop thresholds.
        failed: (b,) at some iteration no pixel of the object could be rendered inside the image.
        iterations: (b,) updates applied.
    """

    T_cam_obj: Float[Array, "b 4 4"]
    converged: Bool[Array, " b"]
    failed: Bool[Array, " b"]
    iterations: Int[Array, " b"]


class Refiner:
    """A trained network with the renderer and the window it was trained for. A context manager.

    Args:
        loaded: Checkpoint.
        meshes: Objects by id, those of the training data.
        device: `auto`, `cpu` or `cuda`.
        batch: Largest number of poses in one forward pass.

    Raises:
        CheckpointError: An object was not trained, or is of another size than the trained one.
        RenderError: There is no device to render on.
    """

    def __init__(
        self, loaded: Checkpoint, meshes: Mapping[int, Mesh], *, device: str = "auto", batch: int = 64
    ) -> None:
        for obj_id, mesh in sorted(meshes.items()):
            _require_trained(loaded, obj_id, mesh)
        self.checkpoint = loaded
        self._meshes = dict(meshes)
        self._device = choose_device(device)
        self._network = loaded.network().to(self._device)
        self._batch = batch
        self._rasteriser = Rasteriser(meshes)

    @classmethod
    def load(cls, path: str | Path, meshes: Mapping[int, Mesh], *, device: str = "auto", batch: int = 64) -> "Refiner":
        """A refiner from a checkpoint file; see the class for arguments and errors."""
        return cls(checkpoint.load(Path(path)), meshes, device=device, batch=batch)

    def __enter__(self) -> "Refiner":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Free what the renderer holds."""
        self._rasteriser.close()

    def refine(
        self,
        image: UInt8[Array, "h w 3"],
        K: Float[Array, "3 3"],
        T_cam_obj: Float[Array, "b 4 4"],
        obj_id: Int[Array, " b"],
        *,
        iterations: int = 5,
    ) -> Refinement:
        """Refine poses in one image, all of them together.

        Args:
            image: RGB.
            K: Its camera.
            T_cam_obj: Start poses, metres.
            obj_id: Object of each.
            iterations: Most updates of a pose; it stops earlier once an update is under 1.5 deg and 7.5 mm.
        """
        b = len(T_cam_obj)
        T = np.asarray(T_cam_obj, np.float64).copy()
        converged, failed, count = np.zeros(b, bool), np.zeros(b, bool), np.zeros(b, np.int64)
        for _ in range(iterations):
            active = np.flatnonzero(~(converged | failed))
            for first in range(0, len(active), self._batch):
                rows = active[first : first + self._batch]
                seen, dR, dt_m = self._updates(image, K, T[rows], obj_id[rows])
                failed[rows[~seen]] = True
                moved = rows[seen]
                T[moved] = se3.apply_update(T[moved], dR, dt_m)
                count[moved] += 1
                small = np.rad2deg(se3.rotation_angle_rad(dR)) < STOP_ANGLE_DEG
                converged[moved] = small & (np.linalg.norm(dt_m, axis=-1) < STOP_DISTANCE_M)
        # The last update is followed by no render of its own, so where it led is looked at here.
        left = np.flatnonzero(~failed)
        failed[left[~self._seen(image, K, T[left], obj_id[left])]] = True
        T[failed] = T_cam_obj[failed]
        return Refinement(T_cam_obj=T, converged=converged & ~failed, failed=failed, iterations=count)

    def _seen(
        self, image: UInt8[Array, "h w 3"], K: Float[Array, "3 3"], T: Float[Array, "b 4 4"], obj_id: Int[Array, " b"]
    ) -> Bool[Array, " b"]:
        """Which poses show at least one pixel of the object inside the image."""
        return self._hypotheses(image, K, T, obj_id)[0]

    def _hypotheses(
        self, image: UInt8[Array, "h w 3"], K: Float[Array, "3 3"], T: Float[Array, "b 4 4"], obj_id: Int[Array, " b"]
    ) -> tuple[Bool[Array, " b"], list[Window], Float[Array, "s 3 3"], UInt8[Array, "s p p 3"]]:
        """Which poses can be seen in the image; of those the windows, their cameras and the renders."""
        p = self.checkpoint.provenance.config.network.patch_px
        windows = [self._window(K, pose, int(i)) for pose, i in zip(T, obj_id, strict=True)]
        rgb, seen = np.zeros((len(T), p, p, 3), np.uint8), np.zeros(len(T), bool)
        K_crop = (
            np.stack([np.eye(3) if w is None else crop_K(K, w, p) for w in windows]) if windows else np.zeros((0, 3, 3))
        )
        drawable = np.array([window is not None for window in windows], bool)
        for i in np.unique(obj_id[drawable]):
            rows = np.flatnonzero(drawable & (obj_id == i))
            layers = self._rasteriser.render(int(i), K_crop[rows], T[rows], p, p)
            rgb[rows] = layers.rgb
            for row, mask in zip(rows, layers.mask, strict=True):
                window = windows[row]
                assert window is not None
                seen[row] = (mask & _inside(window, p, image.shape[1], image.shape[0])).any()
        kept = [window for window, ok in zip(windows, seen, strict=True) if ok and window is not None]
        return seen, kept, K_crop[seen], rgb[seen]

    def _updates(
        self, image: UInt8[Array, "h w 3"], K: Float[Array, "3 3"], T: Float[Array, "b 4 4"], obj_id: Int[Array, " b"]
    ) -> tuple[Bool[Array, " b"], Float[Array, "s 3 3"], Float[Array, "s 3"]]:
        """Which poses can be seen in the image, and the updates of those."""
        seen, windows, K_crop, hypothesis_rgb = self._hypotheses(image, K, T, obj_id)
        if not seen.any():
            return seen, np.zeros((0, 3, 3)), np.zeros((0, 3))
        p = self.checkpoint.provenance.config.network.patch_px
        scenes = np.stack([cut_patch(image, window, p) for window in windows])
        pair = Pair(
            scene_rgb=self._tensor(scenes.transpose(0, 3, 1, 2)),
            hypothesis_rgb=self._tensor(hypothesis_rgb.transpose(0, 3, 1, 2)),
            T_cam_obj=self._tensor(T[seen].astype(np.float32)),
            K_crop=self._tensor(K_crop.astype(np.float32)),
        )
        with torch.no_grad():
            update = self._network(pair)
        # float32 products drift from orthonormal over many iterations, so each update is made a rotation again.
        return seen, se3.nearest_rotation(update.dR.double().cpu().numpy()), update.dt.double().cpu().numpy()

    def _tensor(self, values: Array) -> torch.Tensor:
        return torch.from_numpy(np.ascontiguousarray(values)).to(self._device)

    def _window(self, K: Float[Array, "3 3"], T: Float[Array, "4 4"], obj_id: int) -> Window | None:
        """The window a pose is looked at through; None for one at or behind the camera, or that is not finite."""
        mesh = self._meshes[obj_id]
        if not np.isfinite(T).all() or (T[:3, :3] @ mesh.center_m + T[:3, 3])[2] < 0.6 * mesh.diameter_m:
            return None
        provenance = self.checkpoint.provenance
        if provenance.config.window.kind == "diameter":
            return diameter_window(K, T, mesh.center_m, mesh.diameter_m, provenance.config.window.scale)
        side_px = float(provenance.objects[str(obj_id)]["window_side_px"])
        # The same share of the field of view as in training, so that another camera shows the object at the same size.
        scale = float(K[0, 0]) / provenance.camera_fx_px if provenance.camera_fx_px > 0 else 1.0
        return fixed_window(mesh.vertices_m, K, T, side_px * scale)


def cut_patch(image: UInt8[Array, "h w 3"], window: Window, patch_px: int) -> UInt8[Array, "p p 3"]:
    """The scene patch of a window, antialiased, black outside the image; touches only the window's part of it."""
    margin = 8 + int(2 * window.side_px / patch_px)
    x0, y0 = int(np.floor(window.x0_px)) - margin, int(np.floor(window.y0_px)) - margin
    x1, y1 = int(x0 + window.side_px + 2 * margin + 2), int(y0 + window.side_px + 2 * margin + 2)
    x0, y0, x1, y1 = max(x0, 0), max(y0, 0), min(x1, image.shape[1]), min(y1, image.shape[0])
    if x1 <= x0 or y1 <= y0:
        return np.zeros((patch_px, patch_px, 3), np.uint8)
    part = Window(x0_px=window.x0_px - x0, y0_px=window.y0_px - y0, side_px=window.side_px)
    return np.asarray(cut(np.ascontiguousarray(image[y0:y1, x0:x1]), part, patch_px, interpolation="area"))


def _inside(window: Window, patch_px: int, width_px: int, height_px: int) -> Bool[Array, "p p"]:
    """Which patch pixels lie in the image."""
    centre = (np.arange(patch_px) + 0.5) * window.side_px / patch_px
    u, v = window.x0_px + centre, window.y0_px + centre
    return ((v >= 0) & (v < height_px))[:, None] & ((u >= 0) & (u < width_px))[None]


def _require_trained(loaded: Checkpoint, obj_id: int, mesh: Mesh) -> None:
    objects = loaded.provenance.objects
    if str(obj_id) not in objects:
        known = ", ".join(sorted(objects, key=int))
        raise CheckpointError(
            f"{loaded.path}: object {obj_id} was not in its training data (objects {known}); "
            "choose another checkpoint, or name the objects to refine with --object"
        )
    trained_m = float(objects[str(obj_id)]["diameter_m"])
    if abs(mesh.diameter_m / trained_m - 1) > DIAMETER_TOLERANCE:
        raise CheckpointError(
            f"{loaded.path}: object {obj_id} had a diameter of {1e3 * trained_m:.1f} mm in training, this one has "
            f"{1e3 * mesh.diameter_m:.1f} mm: another object, or another unit"
        )
