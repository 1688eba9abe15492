"""Refinement methods by name, and their settings. Imports no torch, so that the commands can list the names."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal, get_args

from posecore.errors import ConfigError
from posecore.mesh import Mesh

from refinenet.refiner import HypothesisScorer, PoseRefiner

if TYPE_CHECKING:
    from refinenet.models.checkpoint import Checkpoint

MethodName = Literal["network", "edge-icp", "depth-icp", "region", "search"]
METHODS: tuple[MethodName, ...] = get_args(MethodName)
NETWORK: MethodName = "network"
BASELINES = tuple(name for name in METHODS if name != NETWORK)
WITH_NETWORK: tuple[MethodName, ...] = ("search",)
"""Baselines that a network can follow."""
WITH_CONFIDENCE: tuple[MethodName, ...] = (NETWORK, *WITH_NETWORK)
"""Methods with confidences."""


@dataclass(frozen=True, kw_only=True)
class MethodSettings:
    """A refinement method and its settings.

    Attributes:
        method: Name.
        checkpoint: Trained network; None for a baseline without one.
        iterations: Largest number of updates of a pose; for a baseline, at each resolution or search range.
        device: Device of the network: `auto`, `cpu` or `cuda`.
        batch: Largest number of poses in a forward pass.
        allow_other_mesh: Whether to accept a mesh of the trained object's size that is not the trained one.
        min_confidence: A less confident pose fails; None takes the method's default.
        hypotheses: Size of the hypothesis set around each initial pose.
        scorer: Ranking of the hypothesis sets.
        seed: Seed of the hypothesis sets.

    Raises:
        ConfigError: The method is unknown, a network has no checkpoint, or a setting has no effect for the method.
    """

    method: MethodName = NETWORK
    checkpoint: Path | None = None
    iterations: int = 5
    device: str = "auto"
    batch: int = 64
    allow_other_mesh: bool = False
    min_confidence: float | None = None
    hypotheses: int = 1
    scorer: HypothesisScorer = "gradient"
    seed: int = 0

    def __post_init__(self) -> None:
        if self.method not in METHODS:
            raise ConfigError(f"--method: found {self.method!r}, expected {', '.join(METHODS)}")
        if (self.checkpoint is None) == (self.method == NETWORK) and self.method not in WITH_NETWORK:
            needs = "needs a --checkpoint" if self.checkpoint is None else "takes no --checkpoint"
            raise ConfigError(f"--method {self.method} {needs}")
        if self.hypotheses != 1 and self.method != NETWORK:
            raise ConfigError(f"--hypotheses is for --method {NETWORK}, {self.method} does without")
        if self.min_confidence is not None and self.method not in WITH_CONFIDENCE:
            raise ConfigError(
                f"--min-confidence is for --method {' and '.join(WITH_CONFIDENCE)}, {self.method} has no confidences"
            )


def make_refiner(settings: MethodSettings, meshes: Mapping[int, Mesh], loaded: "Checkpoint | None") -> PoseRefiner:
    """The method with these settings; the caller closes it.

    Args:
        settings: Method and settings.
        meshes: Objects by id.
        loaded: The checkpoint that `settings` names, read.

    Raises:
        CheckpointError: An object was not trained, or its mesh is not the trained one.
        ConfigError: A GPU is requested and there is none; a setting is out of range.
        RenderError: There is no device to render on.
    """
    network = None
    if loaded is not None:
        from refinenet.refine.multi_hypothesis import MultiHypothesisRefiner
        from refinenet.refine.network_refiner import Refiner

        network = Refiner(
            loaded, meshes, iterations=settings.iterations, device=settings.device, batch=settings.batch,
            allow_other_mesh=settings.allow_other_mesh,
            min_confidence=(settings.min_confidence or 0.0) if settings.method == NETWORK else 0.0,
        )  # fmt: skip
        if settings.method == NETWORK:
            if settings.hypotheses == 1:
                return network
            return MultiHypothesisRefiner(network, settings.hypotheses, settings.scorer, settings.seed)
    if settings.method == "search":
        from refinenet.baselines.global_search import GradientSearch

        return GradientSearch(
            meshes, iterations=settings.iterations, network=network, min_confidence=settings.min_confidence
        )
    return _local_baseline(settings.method, meshes, settings.iterations)


def _local_baseline(method: MethodName, meshes: Mapping[int, Mesh], iterations: int) -> PoseRefiner:
    if method == "edge-icp":
        from refinenet.baselines.edge_icp import EdgeIcp

        return EdgeIcp(meshes, iterations=iterations)
    if method == "depth-icp":
        from refinenet.baselines.depth_icp import DepthIcp

        return DepthIcp(meshes, iterations=iterations)
    if method == "region":
        from refinenet.baselines.region_tracker import RegionTracker

        return RegionTracker(meshes, iterations=iterations)
    raise ConfigError(f"method {method} needs a checkpoint")
