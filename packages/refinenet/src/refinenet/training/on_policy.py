"""Training on the network's own predictions: hypotheses moved by its update, rendered and cut anew.

A refinement's later iterations start from where the network itself went, which drawn hypotheses do not imitate. So part
of each batch is replaced by pairs whose hypothesis the network has moved once or more, without gradients, as it is at
that step. The new window is cut from the old patch, seen by the patch's camera: labels in 3D stay, distance transforms
are resampled, and what lies beyond the old patch is mirrored, so that no edge shows where it ended.
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
from refinenet.data.split import OWN
from refinenet.geometry import poses
from refinenet.image.crops import hypothesis_window
from refinenet.image.masks import visible_overlap
from refinenet.training.losses import sample_distance

Array = np.ndarray
FARTHEST_SIDE = 2.0
"""A window of another scale than this factor is that of a network gone astray; the pair stays as it was."""


def fraction_at(config: OnPolicyConfig, step: int, steps: int) -> float:
    """Part of a batch that starts from own predictions at a step of a run of `steps`."""
    done, span = step / steps - config.begin, config.full - config.begin
    return config.fraction * (float(np.clip(done / span, 0, 1)) if span > 0 else float(done >= 0))


@dataclass(frozen=True, kw_only=True, eq=False)
class _Looks:
    """Poses that can be seen through windows of their own, cut from old patches.

    `kept` are their rows, `uv_px` where in the old patch the new one's pixels lie, `scale` new pixels per old one.
    """

    kept: Int[Array, " s"]
    T_cam_obj: Float[Array, "s 4 4"]
    K_crop: Float[Array, "s 3 3"]
    rgb: UInt8[Array, "s p p 3"]
    depth_m: Float[Array, "s p p"]
    outline: Bool[Array, "s p p"]
    bits: UInt8[Array, "s p p"]
    uv_px: Float[Tensor, "s p p 2"]
    scale: Float[Array, " s"]


class OnPolicyHypotheses:
    """Replaces part of a batch by pairs that start from the network's own predictions.

    What it does is a pure function of weights, batch, seed, rank, step and part of the step: a resumed run goes on as
    it would have. Nothing is opened until it is needed. A context manager.

    Args:
        config: Of the run.
        meshes: By object id.
        rank: Of this process.
        reduced: Let the network's convolutions run in bfloat16.
    """

    def __init__(
        self, config: TrainConfig, meshes: Mapping[int, Mesh], rank: int = 0, *, reduced: bool = False
    ) -> None:
        self._config, self._meshes, self._rank, self._reduced = config, dict(meshes), rank, reduced
        self._obj_ids = sorted(self._meshes)  # rows of `ObjectPoints`
        self._rasteriser: Rasteriser | None = None

    def __enter__(self) -> "OnPolicyHypotheses":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Free what the renderer holds."""
        if self._rasteriser is not None:
            self._rasteriser.close()
            self._rasteriser = None

    def __call__(self, network: nn.Module, batch: Batch, step: int, part: int = 0) -> Batch:
        """The batch with part of its pairs replaced; as it was while that part is zero.

        Args:
            network: Predicts, in evaluation mode; its mode is left as it was.
            batch: On the network's device.
            step: Of the run, from 0.
            part: Which of the step's batches this is.

        Raises:
            RenderError: There is no device to render on.
        """
        own, b = self._config.on_policy, len(batch.sample_ids)
        share = fraction_at(own, step, self._config.steps)
        if share == 0:
            return batch
        rng = np.random.default_rng([self._config.seed, OWN, step, part, self._rank])
        rows = np.sort(rng.permutation(b)[: int(share * b + rng.random())])
        was_training = network.training
        network.eval()
        for _ in range(int(rng.integers(1, own.updates + 1))):
            if not len(rows):
                break
            batch, rows = self._moved(network, batch, rows, rng)
        network.train(was_training)
        return batch

    @torch.no_grad()
    def _moved(
        self, network: nn.Module, batch: Batch, rows: Int[Array, " r"], rng: np.random.Generator
    ) -> tuple[Batch, Int[Array, " s"]]:
        """The batch after one update of some rows, and those of them that could be looked at where they went."""
        chosen = torch.from_numpy(rows).to(batch.sample_ids.device)
        pair = batch.inputs.mapped(lambda x: x[chosen])
        with torch.autocast(chosen.device.type, torch.bfloat16, enabled=self._reduced):
            update = network(pair)
        T = poses.apply_update(pair.T_cam_obj, update).double().cpu().numpy()
        fits = np.isfinite(T).all(axis=(1, 2))
        T[fits, :3, :3] = se3.nearest_rotation(T[fits, :3, :3])  # float32 products are not quite rotations
        looks = self._look(T, pair.K_crop, batch.target.mapped(lambda x: x[chosen]))
        if looks is None:
            return batch, rows[:0]
        where = chosen[torch.from_numpy(looks.kept).to(chosen.device)]
        colours = None if batch.render_colours is None else batch.render_colours[rows[looks.kept]]
        new = self._pairs(looks, batch.inputs.mapped(lambda x: x[where]), batch.target.mapped(lambda x: x[where]), rng)
        new = new._replace(inputs=new.inputs._replace(hypothesis_rgb=_tinted(looks.rgb, colours).to(chosen.device)))

        def put(old: tuple[Tensor | None, ...], moved: tuple[Tensor | None, ...]) -> list[Tensor | None]:
            both = zip(old, moved, strict=True)
            return [x if x is None or y is None else x.index_copy(0, where, y) for x, y in both]

        inputs, targets = NetworkInput(*put(batch.inputs, new.inputs)), LossTarget(*put(batch.target, new.target))  # type: ignore[arg-type]
        return batch._replace(inputs=inputs, target=targets), rows[looks.kept]

    def _look(self, T: Float[Array, "r 4 4"], K_crop: Tensor, target: LossTarget) -> _Looks | None:
        """What poses look like through windows of their own; None where none of them can be seen."""
        assert target.scene_bits is not None  # every stream fills it
        K, index = K_crop.double().cpu().numpy(), target.object_index.cpu().numpy()
        windows = {i: self._window(K[i], T[i], int(index[i])) for i in range(len(T))}
        drawn = np.array([i for i, window in windows.items() if window is not None], np.int64)
        if not len(drawn):
            return None
        cut = [window for window in windows.values() if window is not None]
        patch_px = self._config.network.patch_px
        K_new = np.stack([crop_K(K[i], window, patch_px) for i, window in zip(drawn, cut, strict=True)])
        if self._rasteriser is None:
            self._rasteriser = Rasteriser(for_patches(self._meshes, patch_px))
        obj_ids = np.array(self._obj_ids)[index[drawn]]
        layers = self._rasteriser.render(obj_ids, K_new, T[drawn], patch_px, patch_px)
        rgb, depth = layers.rgb, layers.depth_m
        assert rgb is not None
        uv = _grid(cut, patch_px).to(K_crop.device)
        bits = _resampled(target.scene_bits[torch.from_numpy(drawn).to(uv.device), None].float(), uv, "nearest")[:, 0]
        host_bits = bits.byte().cpu().numpy()
        outlines = np.stack([contour.contour_mask(d > 0) for d in depth])
        shown = np.minimum(outlines.sum(axis=(1, 2)), ((host_bits & BIT_OBJECT) > 0).sum(axis=(1, 2)))
        good = np.flatnonzero(shown >= MIN_CONTOUR_PX)
        if not len(good):
            return None
        return _Looks(
            kept=drawn[good], T_cam_obj=T[drawn][good], K_crop=K_new[good], rgb=rgb[good], depth_m=depth[good],
            outline=outlines[good], bits=host_bits[good], uv_px=uv[torch.from_numpy(good).to(uv.device)],
            scale=np.array([patch_px / cut[j].side_px for j in good]),
        )  # fmt: skip

    def _pairs(self, looks: _Looks, pair: NetworkInput, target: LossTarget, rng: np.random.Generator) -> Batch:
        """The pairs of what was looked at, made of the old ones; renders' colours are as drawn."""

        def real(values: Array | list[Array]) -> Tensor:
            return torch.from_numpy(np.asarray(values, np.float32)).to(pair.K_crop.device)

        patch_px, n = self._config.network.patch_px, target.hypothesis_contour_m.shape[1]
        masks = looks.depth_m > 0
        points = [
            contour.sample_contour(masks[j], looks.depth_m[j], looks.K_crop[j], n, rng) for j in range(len(masks))
        ]
        scene = _resampled(pair.scene_rgb.float(), looks.uv_px, "bilinear")
        distance = sample_distance(target.scene_distance_px, looks.uv_px.flatten(1, 2))
        new_pair = NetworkInput(
            scene_rgb=(scene + 0.5).clamp(0, 255).byte(), hypothesis_rgb=pair.hypothesis_rgb,
            T_cam_obj=real(looks.T_cam_obj), K_crop=real(looks.K_crop),
            hypothesis_depth_m=None if pair.hypothesis_depth_m is None else real(looks.depth_m),
        )  # fmt: skip
        new_target = target._replace(
            T_cam_obj_hypothesis=new_pair.T_cam_obj,
            K_crop=new_pair.K_crop,
            hypothesis_contour_m=real(points),
            scene_distance_px=distance.unflatten(1, (patch_px, patch_px)) * real(looks.scale)[:, None, None],
            hypothesis_distance_px=real([contour.distance_transform_px(outline) for outline in looks.outline]),
            scene_bits=torch.from_numpy(looks.bits).to(pair.K_crop.device),
            visible_iou=None if target.visible_iou is None else real(visible_overlap(masks, looks.bits)),
        )
        return Batch(new_pair, new_target, torch.from_numpy(looks.kept))

    def _window(self, K_patch: Float[Array, "3 3"], T: Float[Array, "4 4"], index: int) -> Window | None:
        """Window of a pose in the old patch's pixels; None where it cannot be drawn or has left the patch."""
        mesh, patch_px = self._meshes[self._obj_ids[index]], self._config.network.patch_px
        if not np.isfinite(T).all() or (T[:3, :3] @ mesh.center_m + T[:3, 3])[2] < mesh.diameter_m:
            return None
        window = hypothesis_window(self._config.window, K_patch, T, mesh, patch_px)
        apart = max(abs(window.x0_px), abs(window.y0_px))
        if not patch_px / FARTHEST_SIDE < window.side_px < patch_px * FARTHEST_SIDE or apart > patch_px:
            return None
        return window


def _tinted(rgb: UInt8[Array, "s p p 3"], colours: Float[Tensor, "s 3 3"] | None) -> UInt8[Tensor, "s 3 p p"]:
    """Renders with the colours that the batch's augmentation gave theirs."""
    values = torch.from_numpy(rgb.astype(np.float32)).permute(0, 3, 1, 2)
    if colours is not None:
        values = torch.einsum("bij,bjhw->bihw", colours, values)
    return (values + 0.5).clamp(0, 255).byte()


def _grid(windows: list[Window], patch_px: int) -> Float[Tensor, "s p p 2"]:
    """Where in the old patch each pixel centre of the new one lies, continuous pixels."""
    centre = (np.arange(patch_px) + 0.5) / patch_px
    v, u = np.meshgrid(centre, centre, indexing="ij")
    unit = np.stack([u, v], axis=-1)
    uv = np.stack([unit * window.side_px + (window.x0_px, window.y0_px) for window in windows])
    return torch.from_numpy(uv.astype(np.float32))


def _resampled(values: Float[Tensor, "s c p p"], uv: Float[Tensor, "s p p 2"], mode: str) -> Float[Tensor, "s c p p"]:
    """Values at continuous pixels: colours mirrored beyond the patch, masks zero there."""
    grid = uv * (2.0 / values.shape[-1]) - 1.0
    padding = "zeros" if mode == "nearest" else "reflection"
    return torch.nn.functional.grid_sample(values, grid, mode=mode, padding_mode=padding, align_corners=False)
