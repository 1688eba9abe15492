"""Iterative refinement by a network: render the pose, crop both patches, predict, update, until the update is small."""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from posecore import se3
from posecore.errors import CheckpointError, ConfigError
from posecore.mesh import Mesh

from refinenet.batch import NetworkInput
from refinenet.config.network import NetworkKind
from refinenet.device import choose_device
from refinenet.errors import RefinementError
from refinenet.geometry.pivots import PivotFrames
from refinenet.geometry.poses import PoseUpdate
from refinenet.image.edge_gradients import gradient_similarity
from refinenet.models import checkpoint
from refinenet.models.checkpoint import Checkpoint
from refinenet.refine.input_checks import pivots_m, require_trained
from refinenet.refine.patches import Patches, PatchRenderer
from refinenet.refiner import Frame, Refinement, Request, ScoreKind, Status, require_meshes

Scorer = Literal["gradient", "learned"]
STOP_ANGLE_DEG = 1.5
STOP_DISTANCE_M = 7.5e-3
POSES_IN_PASS: dict[NetworkKind, int] = {"paper": 1, "compact": 4, "plus": 4, "flow": 1}
"""Poses of each forward pass on a CPU, which rounds a network's sums by the size of the batch: with another size for
the last poses a result would depend on the others. Those of the small networks share what a pass costs."""

log = logging.getLogger(__name__)


@dataclass(kw_only=True, eq=False)
class _Batch:
    """State of a batch during refinement; fields are changed in place."""

    T: Float[np.ndarray, "b 4 4"]
    obj_id: Int[np.ndarray, " b"]
    converged: Bool[np.ndarray, " b"]
    iterations: Int[np.ndarray, " b"]
    failures: list[str | None]

    def active(self) -> Int[np.ndarray, " a"]:
        """Rows that neither failed nor converged."""
        return np.flatnonzero(np.array([reason is None for reason in self.failures], bool) & ~self.converged)


class Refiner:
    """A trained network with the renderer and window of its training: a `PoseRefiner`, a context manager.

    Args:
        loaded: Checkpoint.
        meshes: Objects by id, those of the training data.
        iterations: Largest number of updates of a pose; an update under 1.5 deg and 7.5 mm is the last.
        device: `auto`, `cpu` or `cuda`.
        batch: Largest number of poses rendered together, on a GPU also in a forward pass, where it is halved, with a
            warning, if the memory is too small. A forward pass on a CPU has `POSES_IN_PASS` poses.
        allow_other_mesh: Accept a mesh of the trained object's size that is not the trained one.
        min_confidence: Least confidence of a refined pose; a less confident one fails.

    Attributes:
        checkpoint: Checkpoint.
        meshes: Objects by id, as given.
        frames: Frames of the checkpoint's pivots, in which poses are updated.
        patch_renderer: Renders and crops the patches, of poses in `frames`.
        device: Device of the network.
        scorer: Source of confidences: `learned` where the network has a confidence output, else `gradient`.

    Raises:
        CheckpointError: An object was not trained, or its mesh is not the trained one.
        ConfigError: A GPU is requested and there is none; less than one iteration or pose in a pass.
        RenderError: There is no device to render on.
    """

    needs_depth = False

    def __init__(
        self,
        loaded: Checkpoint,
        meshes: Mapping[int, Mesh],
        *,
        iterations: int = 5,
        device: str = "auto",
        batch: int = 64,
        allow_other_mesh: bool = False,
        min_confidence: float = 0.0,
    ) -> None:
        for name, value in (("iterations", iterations), ("batch", batch)):
            if value < 1:
                raise ConfigError(f"{name} is {value}, expected 1 or more")
        for obj_id, mesh in sorted(meshes.items()):
            require_trained(loaded, obj_id, mesh, allow_other_mesh=allow_other_mesh)
        self.checkpoint = loaded
        self.meshes: Mapping[int, Mesh] = dict(meshes)
        self.frames = PivotFrames.at(meshes, pivots_m(loaded, meshes))
        self._iterations = iterations
        self._min_confidence = min_confidence
        self.device = choose_device(device)
        self._network = loaded.network().to(self.device)
        self._uses_depth = loaded.provenance.config.network.uses_depth
        self._batch = batch
        kind = loaded.provenance.config.network.kind
        self._pass = POSES_IN_PASS[kind] if self.device.type == "cpu" else batch  # poses in a forward pass
        self.patch_renderer = PatchRenderer(self.frames.meshes, loaded.provenance)
        self.scorer: Scorer = "learned" if self.predict(*_blank(loaded)).confidence is not None else "gradient"

    @classmethod
    def load(cls, path: str | Path, meshes: Mapping[int, Mesh], **settings: Any) -> "Refiner":
        """A refiner from a checkpoint file; see the class for settings and errors."""
        return cls(checkpoint.load(Path(path)), meshes, **settings)

    def __enter__(self) -> "Refiner":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Free the renderer."""
        self.patch_renderer.close()

    @property
    def name(self) -> str:
        """Preset and step."""
        provenance = self.checkpoint.provenance
        return f"refinenet {provenance.config.preset} step {provenance.step}"

    @property
    def score_kind(self) -> ScoreKind:
        """Source of the confidences."""
        return self.scorer

    @property
    def corrects_depth(self) -> bool:
        """Whether updates correct depth: those of optical flow do, other networks hardly."""
        return bool(self.checkpoint.provenance.config.network.kind == "flow")

    @property
    def predicts_pose_quality(self) -> bool:
        """Whether confidences come from an output that was trained on the pose error."""
        return self.scorer == "learned" and self.checkpoint.provenance.config.loss.confidence_target == "pose_quality"

    @property
    def settings(self) -> dict[str, Any]:
        """Settings for the sidecar."""
        provenance = self.checkpoint.provenance
        return {
            "preset": provenance.config.preset,
            "step": provenance.step,
            "iterations": self._iterations,
            "stop_angle_deg": STOP_ANGLE_DEG,
            "stop_distance_mm": 1e3 * STOP_DISTANCE_M,
            "confidence": self.scorer,
            "min_confidence": self._min_confidence,
        }

    def refine(
        self,
        image: UInt8[np.ndarray, "h w 3"],
        K: Float[np.ndarray, "3 3"],
        T_cam_obj: Float[np.ndarray, "4 4"],
        obj_id: int,
    ) -> Refinement:
        """Refine a pose; `refine_batch` refines many at once, which is faster.

        Args:
            image: RGB, of any size.
            K: Camera matrix.
            T_cam_obj: Initial pose, metres.
            obj_id: Object.

        Raises:
            CameraError: K is not a camera matrix, or belongs to an image of another size.
            ConfigError: The object has no mesh here.
            RefinementError: The image is not 8-bit RGB, or the GPU's memory is too small for a single pose.
        """
        return self.refine_batch(Frame(image=image, K=K), [Request(obj_id=obj_id, T_cam_obj=T_cam_obj)])[0]

    def refine_batch(self, frame: Frame, requests: Sequence[Request]) -> list[Refinement]:
        """Refine poses of any objects in an image together; see `refine` for errors."""
        require_meshes(requests, self.meshes)
        return self.frames.own_results(self._refine_all(frame, self.frames.requests(requests)), requests)

    def _refine_all(self, frame: Frame, requests: Sequence[Request]) -> list[Refinement]:
        """Refine poses of the pivots."""
        b = len(requests)
        batch = _Batch(
            T=_poses(requests), obj_id=_objects(requests), converged=np.zeros(b, bool),
            iterations=np.zeros(b, np.int64), failures=[None] * b,
        )  # fmt: skip
        for _ in range(self._iterations):
            active = batch.active()
            for first in range(0, len(active), self._batch):
                self._update(frame, batch, active[first : first + self._batch])
        # No render follows the last update, so the poses after it are rendered and scored here.
        rows = np.array([i for i, reason in enumerate(batch.failures) if reason is None], np.int64)
        scores, failures = self._score(frame, batch.T[rows], batch.obj_id[rows], scorer=None)
        confidences = dict(zip(rows.tolist(), scores.tolist(), strict=True))
        for row, reason in zip(rows.tolist(), failures, strict=True):
            if reason is None and confidences[row] < self._min_confidence:
                reason = f"its confidence, {confidences[row]:.3f}, is below the minimum of {self._min_confidence:g}"
            batch.failures[row] = reason and f"after {batch.iterations[row]} updates {reason}"
        return [
            Refinement(
                T_cam_obj=request.T_cam_obj if reason else batch.T[i],
                status=Status.FAILED if reason else Status.CONVERGED if batch.converged[i] else Status.STOPPED,
                iterations=int(batch.iterations[i]),
                confidence=0.0 if reason else confidences[i],
                failure=reason,
            )
            for i, (request, reason) in enumerate(zip(requests, batch.failures, strict=True))
        ]

    def confidences(
        self, frame: Frame, requests: Sequence[Request], scorer: Scorer | None = None
    ) -> Float[np.ndarray, " b"]:
        """Confidences of poses without refinement, in [0, 1]; 0 for a pose that is not visible.

        Args:
            frame: Image and camera.
            requests: Objects and poses.
            scorer: `gradient` is the gradient similarity of render and image, `learned` the network's confidence
                output; the attribute `scorer` by default.

        Raises:
            CheckpointError: `learned` was requested and the network has no confidence output.
            ConfigError: An object has no mesh here.
        """
        require_meshes(requests, self.meshes)
        return self._score(frame, _poses(self.frames.requests(requests)), _objects(requests), scorer)[0]

    def _update(self, frame: Frame, batch: _Batch, rows: Int[np.ndarray, " a"]) -> None:
        """Update these rows once."""
        patches = self.patch_renderer.render_and_crop(frame, batch.T[rows], batch.obj_id[rows])
        for row, reason in zip(rows, patches.failures, strict=True):
            batch.failures[row] = reason
        if not len(patches.rows):
            return
        visible = rows[patches.rows]
        batch.T[visible], small = self.updated(patches, batch.T[visible])
        batch.iterations[visible] += 1
        batch.converged[visible] = small

    def updated(
        self, patches: Patches, T: Float[np.ndarray, "s 4 4"]
    ) -> tuple[Float[np.ndarray, "s 4 4"], Bool[np.ndarray, " s"]]:
        """Updated poses of the pivots, and a mask of the poses whose update was small."""
        update = self.predict(patches, T)
        # float32 products drift from orthonormal over many iterations, so each update is made a rotation again.
        dR, dt_m = se3.nearest_rotation(update.dR.double().cpu().numpy()), update.dt.double().cpu().numpy()
        small = np.rad2deg(se3.rotation_angle_rad(dR)) < STOP_ANGLE_DEG
        return se3.apply_update(T, dR, dt_m), small & (np.linalg.norm(dt_m, axis=-1) < STOP_DISTANCE_M)

    def _score(
        self, frame: Frame, T: Float[np.ndarray, "b 4 4"], obj_id: Int[np.ndarray, " b"], scorer: Scorer | None
    ) -> tuple[Float[np.ndarray, " b"], list[str | None]]:
        """Confidences of poses, and the reasons why some are not visible."""
        confidence, failures = np.zeros(len(T)), []
        for first in range(0, len(T), self._batch):
            part = slice(first, first + self._batch)
            patches = self.patch_renderer.render_and_crop(frame, T[part], obj_id[part])
            failures += patches.failures
            if len(patches.rows):
                confidence[part][patches.rows] = self._confidence(patches, T[part][patches.rows], scorer)
        return confidence, failures

    def _confidence(
        self, patches: Patches, T: Float[np.ndarray, "s 4 4"], scorer: Scorer | None
    ) -> Float[np.ndarray, " s"]:
        if (scorer or self.scorer) == "learned":
            logit = self.predict(patches, T).confidence
            if logit is None:
                raise CheckpointError(
                    f"{self.checkpoint.path}: its network has no confidence output; choose --scorer gradient"
                )
            return np.asarray(torch.sigmoid(logit.double()).cpu().numpy())
        return gradient_similarity(patches.scene_rgb, patches.hypothesis_rgb, patches.mask, patches.inside)

    def predict(self, patches: Patches, T: Float[np.ndarray, "s 4 4"]) -> PoseUpdate:
        """The network's update for these patches and poses of the pivots, in as many passes as the memory requires."""
        requested = self._pass
        while True:
            try:
                parts = [self._forward(patches, T, first) for first in range(0, len(T), self._pass)]
                break
            except torch.OutOfMemoryError as error:
                if min(self._pass, len(T)) == 1:
                    raise RefinementError(
                        "the GPU's memory is too small for a single pose; free it, or run with --device cpu"
                    ) from error
                self._pass = min(self._pass, len(T)) // 2
        if self._pass != requested:
            fits = self._pass
            log.warning(
                "a batch of %d poses does not fit into the GPU's memory, %d do; use --batch %d", requested, fits, fits
            )
        confidences = [part.confidence for part in parts if part.confidence is not None]
        return PoseUpdate(
            torch.cat([part.dR for part in parts]),
            torch.cat([part.dt for part in parts]),
            torch.cat(confidences) if confidences else None,
        )

    def _forward(self, patches: Patches, T: Float[np.ndarray, "s 4 4"], first: int) -> PoseUpdate:
        count = min(self._pass, len(T) - first)
        rows = np.arange(first, first + (self._pass if self.device.type == "cpu" else count))
        rows = np.minimum(rows, len(T) - 1)  # the last pose fills the pass up
        inputs = NetworkInput(
            scene_rgb=self._tensor(patches.scene_rgb[rows].transpose(0, 3, 1, 2)),
            hypothesis_rgb=self._tensor(patches.hypothesis_rgb[rows].transpose(0, 3, 1, 2)),
            T_cam_obj=self._tensor(T[rows].astype(np.float32)),
            K_crop=self._tensor(patches.K_crop[rows].astype(np.float32)),
            hypothesis_depth_m=self._tensor(patches.depth_m[rows]) if self._uses_depth else None,
        )
        with torch.inference_mode():
            update: PoseUpdate = self._network(inputs)
        confidence = update.confidence
        return PoseUpdate(update.dR[:count], update.dt[:count], None if confidence is None else confidence[:count])

    def _tensor(self, values: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(np.ascontiguousarray(values)).to(self.device)


def _poses(requests: Sequence[Request]) -> Float[np.ndarray, "b 4 4"]:
    return np.array([request.T_cam_obj for request in requests], np.float64).reshape(-1, 4, 4)


def _objects(requests: Sequence[Request]) -> Int[np.ndarray, " b"]:
    return np.array([request.obj_id for request in requests], np.int64)


def _blank(loaded: Checkpoint) -> tuple[Patches, Float[np.ndarray, "1 4 4"]]:
    """An empty patch and its pose: input to find out a network's outputs."""
    p = loaded.provenance.config.network.patch_px
    black = np.zeros((1, p, p, 3), np.uint8)
    K, T = np.array([[[p, 0, p / 2], [0, p, p / 2], [0, 0, 1.0]]]), np.eye(4)[None].copy()
    T[0, 2, 3] = 1.0
    patches = Patches(
        failures=[None], rows=np.zeros(1, np.int64), K_crop=K, scene_rgb=black, hypothesis_rgb=black,
        depth_m=np.zeros((1, p, p), np.float32), inside=np.zeros((1, p, p), bool),
    )  # fmt: skip
    return patches, T
