"""Iterative refinement: render the hypothesis, cut both patches, predict, update, until the update is small."""

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
from refinenet.device import choose_device
from refinenet.errors import RefinementError
from refinenet.geometry.poses import PoseUpdate
from refinenet.image.edge_gradients import gradient_agreement
from refinenet.models import checkpoint
from refinenet.models.checkpoint import Checkpoint
from refinenet.refine.input_checks import require_trained
from refinenet.refine.patches import Viewer, Views
from refinenet.refiner import Frame, Refinement, Request, Status, require_meshes

Array = np.ndarray
Scorer = Literal["gradient", "learned"]
STOP_ANGLE_DEG = 1.5
STOP_DISTANCE_M = 7.5e-3

log = logging.getLogger(__name__)


@dataclass(kw_only=True, eq=False)
class _Batch:
    """Poses while they are refined; fields are changed in place."""

    T: Float[Array, "b 4 4"]
    obj_id: Int[Array, " b"]
    converged: Bool[Array, " b"]
    iterations: Int[Array, " b"]
    failures: list[str | None]

    def active(self) -> Int[Array, " a"]:
        """Rows that still move."""
        return np.array([i for i, why in enumerate(self.failures) if why is None and not self.converged[i]], np.int64)


class Refiner:
    """A trained network with the renderer and the window it was trained for: a `PoseRefiner`, a context manager.

    Args:
        loaded: Checkpoint.
        meshes: Objects by id, those of the training data.
        iterations: Most updates of a pose; it stops earlier once an update is under 1.5 deg and 7.5 mm.
        device: `auto`, `cpu` or `cuda`.
        batch: Largest number of poses in one forward pass; halved, with a warning, where the GPU's memory is too small.
        allow_other_mesh: Take a mesh of the trained object's size that is not the trained one.
        min_confidence: A refined pose that is less confident failed.

    Attributes:
        checkpoint: Checkpoint.
        meshes: Objects by id.
        viewer: What renders and cuts the patches.
        device: Where the network runs.
        scorer: Where confidences come from: `learned` where the network has such an output, else `gradient`.

    Raises:
        CheckpointError: An object was not trained, or its mesh is not the trained one.
        ConfigError: A GPU is asked for and there is none; less than one iteration or pose in a pass.
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
        self.meshes = dict(meshes)
        self._iterations = iterations
        self._min_confidence = min_confidence
        self.device = choose_device(device)
        self._network = loaded.network().to(self.device)
        self._sees_depth = loaded.provenance.config.network.uses_depth
        self._batch = batch
        self.viewer = Viewer(meshes, loaded.provenance)
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
        """Free what the renderer holds."""
        self.viewer.close()

    @property
    def name(self) -> str:
        """Preset and step."""
        provenance = self.checkpoint.provenance
        return f"refinenet {provenance.config.preset} step {provenance.step}"

    @property
    def tells_closeness(self) -> bool:
        """Whether confidences come from an output that was trained to say how near a pose is to the truth."""
        return self.scorer == "learned" and self.checkpoint.provenance.config.loss.confidence_target == "pose_quality"

    @property
    def settings(self) -> dict[str, Any]:
        """For the sidecar."""
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
        self, image: UInt8[Array, "h w 3"], K: Float[Array, "3 3"], T_cam_obj: Float[Array, "4 4"], obj_id: int
    ) -> Refinement:
        """Refine one pose; `refine_batch` takes many, and is faster than one after the other.

        Args:
            image: RGB, of any size.
            K: Its camera.
            T_cam_obj: Start pose, metres.
            obj_id: Object.

        Raises:
            CameraError: K is no camera matrix, or that of an image of another size.
            ConfigError: The object has no mesh here.
            RefinementError: The image is no 8-bit RGB, or the GPU's memory is too small for a single pose.
        """
        return self.refine_batch(Frame(image=image, K=K), [Request(obj_id=obj_id, T_cam_obj=T_cam_obj)])[0]

    def refine_batch(self, frame: Frame, requests: Sequence[Request]) -> list[Refinement]:
        """Refine poses in one image, of any objects, all of them together; see `refine` for errors."""
        require_meshes(requests, self.meshes)
        b = len(requests)
        batch = _Batch(
            T=_poses(requests), obj_id=_objects(requests), converged=np.zeros(b, bool),
            iterations=np.zeros(b, np.int64), failures=[None] * b,
        )  # fmt: skip
        for _ in range(self._iterations):
            active = batch.active()
            for first in range(0, len(active), self._batch):
                self._update(frame, batch, active[first : first + self._batch])
        # The last update is followed by no render of its own, so where it led is looked at here.
        left = np.array([i for i, why in enumerate(batch.failures) if why is None], np.int64)
        confidence, failures = self._judge(frame, batch.T[left], batch.obj_id[left], scorer=None)
        for row, why, found in zip(left, failures, confidence, strict=True):
            if why is None and found < self._min_confidence:
                why = f"its confidence is {found:.3f}, {self._min_confidence:g} needed"
            batch.failures[row] = why and f"after {batch.iterations[row]} updates {why}"
        of_row = dict(zip(left.tolist(), confidence.tolist(), strict=True))
        return [
            Refinement(
                T_cam_obj=np.asarray(request.T_cam_obj, np.float64) if why else batch.T[i],
                status=Status.FAILED if why else Status.CONVERGED if batch.converged[i] else Status.STOPPED,
                iterations=int(batch.iterations[i]),
                confidence=0.0 if why else of_row[i],
                failure=why,
            )
            for i, (request, why) in enumerate(zip(requests, batch.failures, strict=True))
        ]

    def confidences(
        self, frame: Frame, requests: Sequence[Request], scorer: Scorer | None = None
    ) -> Float[Array, " b"]:
        """How well poses fit as they are, in [0, 1]; 0 for one that cannot be seen.

        Args:
            frame: Image and camera.
            requests: Objects and poses.
            scorer: `gradient` compares gradients of render and image (`agreement`), `learned` asks the network; by
                default what the attribute `scorer` says.

        Raises:
            CheckpointError: `learned` was asked for and the network has no such output.
            ConfigError: An object has no mesh here.
        """
        require_meshes(requests, self.meshes)
        return self._judge(frame, _poses(requests), _objects(requests), scorer)[0]

    def _update(self, frame: Frame, batch: _Batch, rows: Int[Array, " a"]) -> None:
        """One update of these rows."""
        views = self.viewer.look(frame, batch.T[rows], batch.obj_id[rows])
        for row, why in zip(rows, views.failures, strict=True):
            batch.failures[row] = why
        if not len(views.rows):
            return
        moved = rows[views.rows]
        batch.T[moved], small = self.moved(views, batch.T[moved])
        batch.iterations[moved] += 1
        batch.converged[moved] = small

    def moved(self, views: Views, T: Float[Array, "s 4 4"]) -> tuple[Float[Array, "s 4 4"], Bool[Array, " s"]]:
        """Updated poses, and whose update was small."""
        update = self.predict(views, T)
        # float32 products drift from orthonormal over many iterations, so each update is made a rotation again.
        dR, dt_m = se3.nearest_rotation(update.dR.double().cpu().numpy()), update.dt.double().cpu().numpy()
        small = np.rad2deg(se3.rotation_angle_rad(dR)) < STOP_ANGLE_DEG
        return se3.apply_update(T, dR, dt_m), small & (np.linalg.norm(dt_m, axis=-1) < STOP_DISTANCE_M)

    def _judge(
        self, frame: Frame, T: Float[Array, "b 4 4"], obj_id: Int[Array, " b"], scorer: Scorer | None
    ) -> tuple[Float[Array, " b"], list[str | None]]:
        """Confidence of poses, and why some cannot be seen."""
        confidence, failures = np.zeros(len(T)), []
        for first in range(0, len(T), self._batch):
            part = slice(first, first + self._batch)
            views = self.viewer.look(frame, T[part], obj_id[part])
            failures += views.failures
            if len(views.rows):
                confidence[part][views.rows] = self._confidence(views, T[part][views.rows], scorer)
        return confidence, failures

    def _confidence(self, views: Views, T: Float[Array, "s 4 4"], scorer: Scorer | None) -> Float[Array, " s"]:
        if (scorer or self.scorer) == "learned":
            logit = self.predict(views, T).confidence
            if logit is None:
                raise CheckpointError(
                    f"{self.checkpoint.path}: its network has no confidence output; choose --scorer gradient"
                )
            return np.asarray(torch.sigmoid(logit.double()).cpu().numpy())
        return gradient_agreement(views.scene_rgb, views.hypothesis_rgb, views.mask, views.inside)

    def predict(self, views: Views, T: Float[Array, "s 4 4"]) -> PoseUpdate:
        """The network's update of these views, in as many passes as memory asks for."""
        wanted = self._batch
        while True:
            try:
                parts = [self._forward(views, T, first) for first in range(0, len(T), self._batch)]
                break
            except torch.OutOfMemoryError as error:
                if min(self._batch, len(T)) == 1:
                    raise RefinementError(
                        "the GPU's memory is too small for a single pose; free it, or run with --device cpu"
                    ) from error
                self._batch = min(self._batch, len(T)) // 2
        if self._batch != wanted:
            fits = self._batch
            log.warning(
                "a batch of %d poses does not fit into the GPU's memory, %d do; use --batch %d", wanted, fits, fits
            )
        confidences = [part.confidence for part in parts if part.confidence is not None]
        return PoseUpdate(
            torch.cat([part.dR for part in parts]),
            torch.cat([part.dt for part in parts]),
            torch.cat(confidences) if confidences else None,
        )

    def _forward(self, views: Views, T: Float[Array, "s 4 4"], first: int) -> PoseUpdate:
        part = slice(first, first + self._batch)
        pair = NetworkInput(
            scene_rgb=self._tensor(views.scene_rgb[part].transpose(0, 3, 1, 2)),
            hypothesis_rgb=self._tensor(views.hypothesis_rgb[part].transpose(0, 3, 1, 2)),
            T_cam_obj=self._tensor(T[part].astype(np.float32)),
            K_crop=self._tensor(views.K_crop[part].astype(np.float32)),
            hypothesis_depth_m=self._tensor(views.depth_m[part]) if self._sees_depth else None,
        )
        with torch.inference_mode():
            update: PoseUpdate = self._network(pair)
        return update

    def _tensor(self, values: Array) -> torch.Tensor:
        return torch.from_numpy(np.ascontiguousarray(values)).to(self.device)


def _poses(requests: Sequence[Request]) -> Float[Array, "b 4 4"]:
    return np.array([request.T_cam_obj for request in requests], np.float64).reshape(-1, 4, 4)


def _objects(requests: Sequence[Request]) -> Int[Array, " b"]:
    return np.array([request.obj_id for request in requests], np.int64)


def _blank(loaded: Checkpoint) -> tuple[Views, Float[Array, "1 4 4"]]:
    """An empty view, to see what a network gives."""
    p = loaded.provenance.config.network.patch_px
    black, off, far = np.zeros((1, p, p, 3), np.uint8), np.zeros((1, p, p), bool), np.zeros((1, p, p), np.float32)
    K, T = np.array([[[p, 0, p / 2], [0, p, p / 2], [0, 0, 1.0]]]), np.eye(4)[None].copy()
    T[0, 2, 3] = 1.0
    views = Views(
        failures=[None], rows=np.zeros(1, np.int64), K_crop=K, scene_rgb=black, hypothesis_rgb=black, depth_m=far,
        inside=off,
    )  # fmt: skip
    return views, T
