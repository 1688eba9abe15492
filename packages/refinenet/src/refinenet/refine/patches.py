"""Patches of hypotheses: window, render and scene patch of each pose, or the reason why there is none."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from posecore.camera import crop_K, project
from posecore.mesh import Mesh
from posecore.raster import Rasteriser
from posecore.window import Window, cut_rgb, diameter_window, fixed_window, pixels_inside

from refinenet.models.checkpoint import Provenance
from refinenet.refiner import Frame, render_obstacle


@dataclass(frozen=True, kw_only=True, eq=False)
class Patches:
    """Patches of a batch of poses in an image.

    Attributes:
        failures: (b) reason why a pose is not visible; None for the visible ones.
        rows: (s,) batch rows of the visible poses, which all other fields hold.
        K_crop: Cameras of the patches.
        scene_rgb: Patches of the image, black outside the image.
        hypothesis_rgb: Renders on black in the same windows.
        depth_m: Camera z of the renders, 0 beside the object.
        inside: Patch pixels that lie in the image.
    """

    failures: list[str | None]
    rows: Int[np.ndarray, " s"]
    K_crop: Float[np.ndarray, "s 3 3"]
    scene_rgb: UInt8[np.ndarray, "s p p 3"]
    hypothesis_rgb: UInt8[np.ndarray, "s p p 3"]
    depth_m: Float[np.ndarray, "s p p"]
    inside: Bool[np.ndarray, "s p p"]

    @property
    def mask(self) -> Bool[np.ndarray, "s p p"]:
        """Silhouettes of the renders."""
        return self.depth_m > 0


class PatchRenderer:
    """Renders and crops poses through the windows that a network was trained with, until it is closed.

    Args:
        meshes: Objects by id.
        provenance: Provenance of the network: patch size, kind of window, training camera.

    Raises:
        RenderError: There is no device to render on.
    """

    def __init__(self, meshes: Mapping[int, Mesh], provenance: Provenance) -> None:
        self._meshes = dict(meshes)
        self._provenance = provenance
        self._patch_px = provenance.config.network.patch_px
        self._rasteriser = Rasteriser(meshes)

    def close(self) -> None:
        """Free the renderer."""
        self._rasteriser.close()

    @property
    def device(self) -> str:
        """Name of the rendering device."""
        return self._rasteriser.device

    def render_and_crop(
        self, frame: Frame, T_cam_obj: Float[np.ndarray, "b 4 4"], obj_id: Int[np.ndarray, " b"]
    ) -> Patches:
        """Patches of poses in a frame; a pose without an object pixel inside the image has none."""
        p, b = self._patch_px, len(T_cam_obj)
        height_px, width_px = frame.image.shape[:2]
        failures = [render_obstacle(T, self._meshes[int(i)]) for T, i in zip(T_cam_obj, obj_id, strict=True)]
        windows = {
            row: self._window(frame.K, T_cam_obj[row], int(obj_id[row])) for row in range(b) if failures[row] is None
        }
        K_crop = {row: crop_K(frame.K, window, p) for row, window in windows.items()}
        rgb, depth_m = np.zeros((b, p, p, 3), np.uint8), np.zeros((b, p, p), np.float32)
        inside = np.zeros((b, p, p), bool)
        drawable = np.array(sorted(windows), np.int64)
        if len(drawable):
            cameras = np.stack([K_crop[int(r)] for r in drawable])
            layers = self._rasteriser.render(obj_id[drawable], cameras, T_cam_obj[drawable], p, p)
            rgb[drawable], depth_m[drawable] = layers.rgb, layers.depth_m
        for row, window in windows.items():
            inside[row] = pixels_inside(window, p, width_px, height_px)
            centre_m = self._meshes[int(obj_id[row])].center_cam_m(T_cam_obj[row])
            if not (depth_m[row] > 0).any():
                failures[row] = f"its render at {centre_m[2]:.3g} m covers no pixel"
            elif not ((depth_m[row] > 0) & inside[row]).any():
                u, v = project(frame.K, centre_m[None])[0]
                failures[row] = f"it lies at ({u:.0f}, {v:.0f}) px, outside the image of {width_px} x {height_px} px"
        visible = np.array([row for row in range(b) if failures[row] is None], np.int64)
        return Patches(
            failures=failures,
            rows=visible,
            K_crop=np.array([K_crop[int(r)] for r in visible]).reshape(-1, 3, 3),
            scene_rgb=_stacked([cut_rgb(frame.image, windows[int(r)], p) for r in visible], p),
            hypothesis_rgb=rgb[visible],
            depth_m=depth_m[visible],
            inside=inside[visible],
        )

    def _window(self, K: Float[np.ndarray, "3 3"], T: Float[np.ndarray, "4 4"], obj_id: int) -> Window:
        mesh, provenance = self._meshes[obj_id], self._provenance
        if provenance.config.window.kind == "diameter":
            return diameter_window(K, T, mesh.center_m, mesh.diameter_m, provenance.config.window.scale)
        side_px = provenance.window_side_px(obj_id)
        # The training camera's fraction of the field of view, so that another camera shows the object at the same size.
        scale = float(K[0, 0]) / provenance.camera_fx_px if provenance.camera_fx_px > 0 else 1.0
        return fixed_window(mesh.vertices_m, K, T, side_px * scale)


def _stacked(patches: Sequence[UInt8[np.ndarray, "p p 3"]], patch_px: int) -> UInt8[np.ndarray, "s p p 3"]:
    return np.stack(patches) if patches else np.zeros((0, patch_px, patch_px, 3), np.uint8)
