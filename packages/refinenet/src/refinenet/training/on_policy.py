"""On-policy hypotheses: poses updated by the network itself, with new renders and online crops.

A refinement's later iterations start from the network's output, whose errors differ from those of drawn hypotheses (cf.
DAgger). So part of each batch is replaced by pairs whose hypothesis the network has updated once or more, without
gradients, with its weights at that step. The new window is cut from the old patch, with the patch's camera: 3D labels
stay, distance transforms are resampled, and the image is mirrored beyond the old patch, so that its edge does not show.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from types import TracebackType

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from posecore import contour, se3
from posecore.camera import crop_K
from posecore.mesh import Mesh
from posecore.raster import Rasteriser
from posecore.shard import BIT_OBJECT
from posecore.window import Window
from torch import Tensor, nn

from refinenet.batch import Batch, LossTarget, NetworkInput
from refinenet.config import OnPolicyConfig, TrainConfig
from refinenet.data.objects import for_patches
from refinenet.data.online_pairs import MIN_CONTOUR_PX
from refinenet.data.split import ON_POLICY
from refinenet.geometry import poses
from refinenet.image.crops import hypothesis_window
from refinenet.image.masks import visible_mask_iou
from refinenet.training.losses import sample_distance

MAX_SCALE_CHANGE = 2.0
"""Largest ratio of old and new window side; beyond it the update has diverged, and the pair stays as it is."""


def fraction_at(config: OnPolicyConfig, step: int, steps: int) -> float:
    """Fraction of a batch with on-policy hypotheses at a step of a run of `steps`."""
    done, span = step / steps - config.begin, config.full - config.begin
    return config.fraction * (float(np.clip(done / span, 0, 1)) if span > 0 else float(done >= 0))


@dataclass(frozen=True, kw_only=True, eq=False)
class _Renders:
    """Updated hypotheses that are visible in their new windows, rendered.

    `kept` are their rows, `uv_px` the positions of the new patch's pixels in the old patch, `scale` new pixels per old
    pixel.
    """

    kept: Int[np.ndarray, " s"]
    T_cam_obj: Float[np.ndarray, "s 4 4"]
    K_crop: Float[np.ndarray, "s 3 3"]
    rgb: UInt8[np.ndarray, "s p p 3"]
    depth_m: Float[np.ndarray, "s p p"]
    outline: Bool[np.ndarray, "s p p"]
    bits: UInt8[np.ndarray, "s p p"]
    uv_px: Float[Tensor, "s p p 2"]
    scale: Float[np.ndarray, " s"]


class OnPolicyHypotheses:
    """Replacement of part of a batch by pairs with on-policy hypotheses.

    The result is a pure function of weights, batch, seed, rank, step and part of the step, as resuming needs. The
    rasteriser is opened at the first use. A context manager.

    Args:
        config: Configuration of the run.
        meshes: By object id.
        rank: Index of this process.
        bfloat16: Run the network's convolutions in bfloat16.
    """

    def __init__(
        self, config: TrainConfig, meshes: Mapping[int, Mesh], rank: int = 0, *, bfloat16: bool = False
    ) -> None:
        self._config, self._meshes, self._rank, self._bfloat16 = config, dict(meshes), rank, bfloat16
        self._obj_ids = sorted(self._meshes)  # rows of `ObjectPoints`
        self._rasteriser: Rasteriser | None = None

    def __enter__(self) -> "OnPolicyHypotheses":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Free the rasteriser."""
        if self._rasteriser is not None:
            self._rasteriser.close()
            self._rasteriser = None

    def __call__(self, network: nn.Module, batch: Batch, step: int, part: int = 0) -> Batch:
        """The batch with part of its pairs replaced; unchanged while the fraction is zero.

        Args:
            network: Network, evaluated in evaluation mode; its mode is restored.
            batch: Batch on the network's device.
            step: Step of the run, from 0.
            part: Index of the batch within the step.

        Raises:
            RenderError: There is no device to render on.
        """
        config, b = self._config.on_policy, len(batch.sample_ids)
        fraction = fraction_at(config, step, self._config.steps)
        if fraction == 0:
            return batch
        rng = np.random.default_rng([self._config.seed, ON_POLICY, step, part, self._rank])
        rows = np.sort(rng.permutation(b)[: int(fraction * b + rng.random())])
        was_training = network.training
        network.eval()
        for _ in range(int(rng.integers(1, config.updates + 1))):
            if not len(rows):
                break
            batch, rows = self._updated(network, batch, rows, rng)
        network.train(was_training)
        return batch

    @torch.no_grad()
    def _updated(
        self, network: nn.Module, batch: Batch, rows: Int[np.ndarray, " r"], rng: np.random.Generator
    ) -> tuple[Batch, Int[np.ndarray, " s"]]:
        """The batch after one update of some rows, and the rows whose updated hypothesis is visible."""
        chosen = torch.from_numpy(rows).to(batch.sample_ids.device)
        inputs = batch.inputs.mapped(lambda x: x[chosen])
        with torch.autocast(chosen.device.type, torch.bfloat16, enabled=self._bfloat16):
            update = network(inputs)
        T = poses.apply_update(inputs.T_cam_obj, update).double().cpu().numpy()
        fits = np.isfinite(T).all(axis=(1, 2))
        T[fits, :3, :3] = se3.nearest_rotation(T[fits, :3, :3])  # float32 products are not quite rotations
        renders = self._render(T, inputs.K_crop, batch.target.mapped(lambda x: x[chosen]))
        if renders is None:
            return batch, rows[:0]
        index = chosen[torch.from_numpy(renders.kept).to(chosen.device)]
        colours = None if batch.render_colours is None else batch.render_colours[rows[renders.kept]]
        new = self._pairs(
            renders, batch.inputs.mapped(lambda x: x[index]), batch.target.mapped(lambda x: x[index]), rng
        )
        new = new._replace(inputs=new.inputs._replace(hypothesis_rgb=_tinted(renders.rgb, colours).to(chosen.device)))

        def put(old: tuple[Tensor | None, ...], updated: tuple[Tensor | None, ...]) -> list[Tensor | None]:
            both = zip(old, updated, strict=True)
            return [x if x is None or y is None else x.index_copy(0, index, y) for x, y in both]

        inputs, targets = NetworkInput(*put(batch.inputs, new.inputs)), LossTarget(*put(batch.target, new.target))  # type: ignore[arg-type]
        return batch._replace(inputs=inputs, target=targets), rows[renders.kept]

    def _render(self, T: Float[np.ndarray, "r 4 4"], K_crop: Tensor, target: LossTarget) -> _Renders | None:
        """Poses rendered in windows of their own; None when no pose is visible."""
        assert target.scene_bits is not None
        K, index = K_crop.double().cpu().numpy(), target.object_index.cpu().numpy()
        windows = {i: self._window(K[i], T[i], int(index[i])) for i in range(len(T))}
        drawn = np.array([i for i, window in windows.items() if window is not None], np.int64)
        if not len(drawn):
            return None
        cut = [window for window in windows.values() if window is not None]
        patch_px = self._config.network.patch_px
        K_new = np.stack([crop_K(K[i], window, patch_px) for i, window in zip(drawn, cut, strict=True)])
        if self._rasteriser is None:
            self._rasteriser = Rasteriser(for_patches(self._meshes))
        obj_ids = np.array(self._obj_ids)[index[drawn]]
        layers = self._rasteriser.render(obj_ids, K_new, T[drawn], patch_px, patch_px)
        rgb, depth = layers.rgb, layers.depth_m
        assert rgb is not None
        uv = _grid(cut, patch_px).to(K_crop.device)
        bits = _resampled(target.scene_bits[torch.from_numpy(drawn).to(uv.device), None].float(), uv, "nearest")[:, 0]
        host_bits = bits.byte().cpu().numpy()
        outlines = np.stack([contour.contour_mask(d > 0) for d in depth])
        contour_px = np.minimum(outlines.sum(axis=(1, 2)), ((host_bits & BIT_OBJECT) > 0).sum(axis=(1, 2)))
        good = np.flatnonzero(contour_px >= MIN_CONTOUR_PX)
        if not len(good):
            return None
        return _Renders(
            kept=drawn[good], T_cam_obj=T[drawn][good], K_crop=K_new[good], rgb=rgb[good], depth_m=depth[good],
            outline=outlines[good], bits=host_bits[good], uv_px=uv[torch.from_numpy(good).to(uv.device)],
            scale=np.array([patch_px / cut[j].side_px for j in good]),
        )  # fmt: skip

    def _pairs(self, renders: _Renders, inputs: NetworkInput, target: LossTarget, rng: np.random.Generator) -> Batch:
        """New pairs of the renders, whose colours are not augmented yet, and the old pairs."""

        def real(values: np.ndarray | list[np.ndarray]) -> Tensor:
            return torch.from_numpy(np.asarray(values, np.float32)).to(inputs.K_crop.device)

        patch_px, n = self._config.network.patch_px, target.hypothesis_contour_m.shape[1]
        masks = renders.depth_m > 0
        points = [
            contour.sample_contour(masks[j], renders.depth_m[j], renders.K_crop[j], n, rng) for j in range(len(masks))
        ]
        scene = _resampled(inputs.scene_rgb.float(), renders.uv_px, "bilinear")
        distance = sample_distance(target.scene_distance_px, renders.uv_px.flatten(1, 2))
        new_inputs = NetworkInput(
            scene_rgb=(scene + 0.5).clamp(0, 255).byte(), hypothesis_rgb=inputs.hypothesis_rgb,
            T_cam_obj=real(renders.T_cam_obj), K_crop=real(renders.K_crop),
            hypothesis_depth_m=None if inputs.hypothesis_depth_m is None else real(renders.depth_m),
        )  # fmt: skip
        new_target = target._replace(
            T_cam_obj_hypothesis=new_inputs.T_cam_obj,
            K_crop=new_inputs.K_crop,
            hypothesis_contour_m=real(points),
            scene_distance_px=distance.unflatten(1, (patch_px, patch_px)) * real(renders.scale)[:, None, None],
            hypothesis_distance_px=real([contour.distance_transform_px(outline) for outline in renders.outline]),
            scene_bits=torch.from_numpy(renders.bits).to(inputs.K_crop.device),
            visible_iou=None if target.visible_iou is None else real(visible_mask_iou(masks, renders.bits)),
        )
        return Batch(new_inputs, new_target, torch.from_numpy(renders.kept))

    def _window(self, K_patch: Float[np.ndarray, "3 3"], T: Float[np.ndarray, "4 4"], index: int) -> Window | None:
        """Window of a pose in the old patch's pixels; None for a pose too near to render or outside the patch."""
        mesh, patch_px = self._meshes[self._obj_ids[index]], self._config.network.patch_px
        if not np.isfinite(T).all() or mesh.center_cam_m(T)[2] < mesh.diameter_m:
            return None
        window = hypothesis_window(self._config.window, K_patch, T, mesh, patch_px)
        shift_px = max(abs(window.x0_px), abs(window.y0_px))
        if not patch_px / MAX_SCALE_CHANGE < window.side_px < patch_px * MAX_SCALE_CHANGE or shift_px > patch_px:
            return None
        return window


def _tinted(rgb: UInt8[np.ndarray, "s p p 3"], colours: Float[Tensor, "s 3 3"] | None) -> UInt8[Tensor, "s 3 p p"]:
    """Renders under the colour matrices of the batch's augmentation."""
    values = torch.from_numpy(rgb.astype(np.float32)).permute(0, 3, 1, 2)
    if colours is not None:
        values = torch.einsum("bij,bjhw->bihw", colours, values)
    return (values + 0.5).clamp(0, 255).byte()


def _grid(windows: list[Window], patch_px: int) -> Float[Tensor, "s p p 2"]:
    """Positions of the new patch's pixel centres in the old patch, continuous pixels."""
    centre = (np.arange(patch_px) + 0.5) / patch_px
    v, u = np.meshgrid(centre, centre, indexing="ij")
    unit = np.stack([u, v], axis=-1)
    uv = np.stack([unit * window.side_px + (window.x0_px, window.y0_px) for window in windows])
    return torch.from_numpy(uv.astype(np.float32))


def _resampled(values: Float[Tensor, "s c p p"], uv: Float[Tensor, "s p p 2"], mode: str) -> Float[Tensor, "s c p p"]:
    """Values at continuous pixels; beyond the patch, colours are mirrored and masks are zero."""
    grid = uv * (2.0 / values.shape[-1]) - 1.0
    padding = "zeros" if mode == "nearest" else "reflection"
    return torch.nn.functional.grid_sample(values, grid, mode=mode, padding_mode=padding, align_corners=False)
