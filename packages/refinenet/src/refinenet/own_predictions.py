"""Training on the network's own predictions: hypotheses moved by its update, rendered and cut anew.

A refinement's later iterations start from where the network itself went, which drawn hypotheses do not imitate. So part
of each batch is replaced by pairs whose hypothesis the network has moved once or more, without gradients, as it is at
that step. The new window is cut from the old patch, seen by the patch's camera: labels in 3D stay, distance transforms
are resampled, and what lies beyond the old patch is mirrored, so that no edge shows where it ended.
"""

from collections.abc import Mapping
from types import TracebackType

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from posecore import contour, se3
from posecore.camera import crop_K
from posecore.mesh import Mesh
from posecore.raster import Rasteriser
from posecore.shard import BIT_OBJECT
from posecore.window import Window
from torch import Tensor, nn

from refinenet import geometry
from refinenet.config import OwnPredictionsConfig, TrainConfig
from refinenet.data import Batch
from refinenet.hypothesis import MIN_CONTOUR_PX
from refinenet.loss import Target, sample_distance
from refinenet.network import Pair
from refinenet.recut import hypothesis_window
from refinenet.split import OWN
from refinenet.visibility import visible_overlap

Array = np.ndarray
FARTHEST_SIDE = 2.0
"""A window of another scale than this factor is that of a network gone astray; the pair stays as it was."""


def share_at(config: OwnPredictionsConfig, step: int, steps: int) -> float:
    """Part of a batch that starts from own predictions at a step of a run of `steps`."""
    done, span = step / steps - config.begin, config.full - config.begin
    return config.share * (float(np.clip(done / span, 0, 1)) if span > 0 else float(done >= 0))


class OwnPredictions:
    """Replaces part of a batch by pairs that start from the network's own predictions.

    What it does is a pure function of weights, batch, seed, rank, step and part of the step: a resumed run goes on as
    it would have. Nothing is opened until it is needed. A context manager.

    Args:
        config: Of the run.
        meshes: By object id.
        rank: Of this process.
    """

    def __init__(self, config: TrainConfig, meshes: Mapping[int, Mesh], rank: int = 0) -> None:
        self._config, self._meshes, self._rank = config, dict(meshes), rank
        self._obj_ids = sorted(self._meshes)  # rows of `ObjectPoints`
        self._rasteriser: Rasteriser | None = None

    def __enter__(self) -> "OwnPredictions":
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
        own, b = self._config.own_predictions, len(batch.sample_ids)
        share = share_at(own, step, self._config.steps)
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
        pair, target = Pair(*(x[chosen] for x in batch.pair)), _rows(batch.target, chosen)
        T = geometry.apply_update(pair.T_cam_obj, network(pair)).double().cpu().numpy()
        fits = np.isfinite(T).all(axis=(1, 2))
        T[fits, :3, :3] = se3.nearest_rotation(T[fits, :3, :3])  # float32 products are not quite rotations
        K = pair.K_crop.double().cpu().numpy()
        index = target.object_index.cpu().numpy()
        windows = [self._window(K[i], T[i], int(index[i])) for i in range(len(rows))]
        fine = [i for i, window in enumerate(windows) if window is not None]
        seen = [window for window in windows if window is not None]
        if not seen:
            return batch, rows[:0]
        at = torch.tensor(fine, device=chosen.device)
        uv = _grid(seen, self._config.network.patch_px, chosen.device)
        bits = _resampled(_known(target.scene_bits)[at, None].float(), uv, "nearest")[:, 0].byte()
        patch_px = self._config.network.patch_px
        K_new = np.stack([crop_K(K[i], window, patch_px) for i, window in zip(fine, seen, strict=True)])
        rgb, depth = self._render(index[fine], K_new, T[fine])
        host_bits = bits.cpu().numpy()
        outlines = [contour.contour_mask(d > 0) for d in depth]
        good = [
            j
            for j, outline in enumerate(outlines)
            if min(outline.sum(), ((host_bits[j] & BIT_OBJECT) > 0).sum()) >= MIN_CONTOUR_PX
        ]
        if not good:
            return batch, rows[:0]
        kept = np.array([fine[j] for j in good])
        where, uv, side = chosen[at[good]], uv[good], torch.tensor([seen[j].side_px for j in good])
        scale = (patch_px / side).to(uv)[:, None, None]
        distance = sample_distance(target.scene_distance_px[at[good]], uv.flatten(1, 2))
        n = target.hypothesis_contour_m.shape[1]
        points = [contour.sample_contour(depth[j] > 0, depth[j], K_new[j], n, rng) for j in good]

        def real(values: Array | list[Array]) -> Tensor:
            return torch.from_numpy(np.asarray(values, np.float32)).to(chosen.device)

        tinted = self._tinted(rgb[good], batch.render_colours, rows[kept])
        scene = _resampled(pair.scene_rgb[at[good]].float(), uv, "bilinear")
        T_new, K_good = real(T[kept]), real(K_new[good])
        overlap = visible_overlap(depth[good] > 0, host_bits[good])
        new_pair = Pair((scene + 0.5).clamp(0, 255).byte(), tinted.to(chosen.device), T_new, K_good)
        new_target = target._replace(
            T_cam_obj=target.T_cam_obj[at[good]],
            T_cam_obj_hypothesis=T_new,
            K_crop=K_good,
            scene_contour_m=target.scene_contour_m[at[good]],
            hypothesis_contour_m=real(points),
            scene_distance_px=distance.unflatten(1, (patch_px, patch_px)) * scale,
            hypothesis_distance_px=real([contour.distance_transform_px(outlines[j]) for j in good]),
            object_index=target.object_index[at[good]],
            scene_bits=bits[good],
            overlap=None if target.overlap is None else real(overlap),
        )
        return batch._replace(
            pair=Pair(*(x.index_copy(0, where, y) for x, y in zip(batch.pair, new_pair, strict=True))),
            target=Target(
                *(
                    None if x is None or y is None else x.index_copy(0, where, y)
                    for x, y in zip(batch.target, new_target, strict=True)
                )
            ),
        ), rows[kept]

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

    def _render(
        self, index: Int[Array, " s"], K: Float[Array, "s 3 3"], T: Float[Array, "s 4 4"]
    ) -> tuple[UInt8[Array, "s p p 3"], Float[Array, "s p p"]]:
        if self._rasteriser is None:
            self._rasteriser = Rasteriser(self._meshes)
        p = self._config.network.patch_px
        rgb, depth = np.zeros((len(T), p, p, 3), np.uint8), np.zeros((len(T), p, p), np.float32)
        for i in np.unique(index):
            rows = np.flatnonzero(index == i)
            layers = self._rasteriser.render(self._obj_ids[i], K[rows], T[rows], p, p)
            rgb[rows], depth[rows] = layers.rgb, layers.depth_m
        return rgb, depth

    @staticmethod
    def _tinted(rgb: UInt8[Array, "s p p 3"], colours: Tensor | None, rows: Int[Array, " s"]) -> Tensor:
        """Renders with the colours that the batch's augmentation gave theirs, channels first."""
        values = torch.from_numpy(rgb.astype(np.float32)).permute(0, 3, 1, 2)
        if colours is not None:
            values = torch.einsum("bij,bjhw->bihw", colours.cpu()[rows], values)
        return (values + 0.5).clamp(0, 255).byte()


def _rows(target: Target, rows: Tensor) -> Target:
    return Target(*(None if x is None else x[rows] for x in target))


def _known(bits: Tensor | None) -> Tensor:
    assert bits is not None  # every stream fills it
    return bits


def _grid(windows: list[Window], patch_px: int, device: torch.device) -> Float[Tensor, "s p p 2"]:
    """Where in the old patch each pixel centre of the new one lies, continuous pixels."""
    centre = (np.arange(patch_px) + 0.5) / patch_px
    v, u = np.meshgrid(centre, centre, indexing="ij")
    unit = np.stack([u, v], axis=-1)
    uv = np.stack([unit * window.side_px + (window.x0_px, window.y0_px) for window in windows])
    return torch.from_numpy(uv.astype(np.float32)).to(device)


def _resampled(values: Float[Tensor, "s c p p"], uv: Float[Tensor, "s p p 2"], mode: str) -> Float[Tensor, "s c p p"]:
    """Values at continuous pixels: colours mirrored beyond the patch, masks zero there."""
    grid = uv * (2.0 / values.shape[-1]) - 1.0
    padding = "zeros" if mode == "nearest" else "reflection"
    return torch.nn.functional.grid_sample(values, grid, mode=mode, padding_mode=padding, align_corners=False)
