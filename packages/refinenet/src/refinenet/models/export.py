"""Networks for other runtimes: ONNX and torch.export programs, compared with the network they came from."""

import importlib.util
import io
import json
import logging
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from posecore import config as posecore_config
from posecore.errors import CheckpointError, ConfigError
from posecore.files import write_atomic
from torch import Tensor, nn

from refinenet.batch import NetworkInput
from refinenet.config import NetworkConfig
from refinenet.models.checkpoint import Checkpoint

INPUTS = ("scene_rgb", "hypothesis_rgb", "T_cam_obj", "K_crop", "hypothesis_depth_m")
"""The last for networks with depth input only."""
OUTPUTS = ("dR", "dt_m", "confidence_logit")
TOLERANCES = {"dR": 1e-4, "dt_m": 1e-5, "confidence_logit": 1e-3}
"""Largest difference from the network in any entry: of a rotation, in metres, of a logit."""
OPSET = 18
CHECKED_BATCHES = (1, 5)

Outputs = dict[str, np.ndarray]


class FlatNetwork(nn.Module):
    """A network with plain tensors as inputs and outputs: `INPUTS` to `OUTPUTS`, as far as it has them."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(
        self, scene_rgb: Tensor, hypothesis_rgb: Tensor, T_cam_obj: Tensor, K_crop: Tensor,
        hypothesis_depth_m: Tensor | None = None,
    ) -> tuple[Tensor, ...]:  # fmt: skip
        """The update of each pair, in camera axes about the pivot, which `T_cam_obj` is a pose of."""
        update = self.network(NetworkInput(scene_rgb, hypothesis_rgb, T_cam_obj, K_crop, hypothesis_depth_m))
        return (update.dR, update.dt) if update.confidence is None else (update.dR, update.dt, update.confidence)


def export(loaded: Checkpoint, out: Path) -> dict[str, float]:
    """Write a network as ONNX (`.onnx`) or as a torch.export program (`.pt2`), of any batch size, and check the file.

    The file has metadata `refinenet` (JSON) for its user: patch, window, pivot, objects, checkpoint hash. Input
    `T_cam_obj` is the pose of the pivot (`se3.with_origin_at`): the object's centre, or its mesh's origin.

    Args:
        loaded: Checkpoint.
        out: File; written atomically, and only if the check passes.

    Returns:
        Largest difference of each output from the network's, over batches of 1 and 5 random pairs.

    Raises:
        ConfigError: Another file name extension, or a missing package.
        CheckpointError: The exported network differs by more than `TOLERANCES`.
    """
    if out.suffix not in (".onnx", ".pt2"):
        raise ConfigError(f"{out}: choose a name ending in .onnx (ONNX) or .pt2 (torch.export)")
    network = FlatNetwork(loaded.network()).eval()
    for parameter in network.parameters():
        parameter.requires_grad_(False)
    about = json.dumps(_about(loaded))
    config = loaded.provenance.config.network
    example = random_pairs(2, config.patch_px, seed=0, depth=config.uses_depth)
    content = _onnx(network, example, about) if out.suffix == ".onnx" else _program(network, example, about)
    run = _onnx_runner(content) if out.suffix == ".onnx" else _program_runner(content)
    differences = _differences(network, run, config)
    for name, difference in differences.items():
        if not difference <= TOLERANCES[name]:
            raise CheckpointError(
                f"{loaded.path}: exported, its {name} differs by {difference:.2g} from the network's, expected at most "
                f"{TOLERANCES[name]:.0e}; {out} was not written"
            )
    write_atomic(out, content)
    return differences


def random_pairs(b: int, patch_px: int, seed: int, *, depth: bool = False) -> tuple[Tensor, ...]:
    """Inputs of plausible sizes, in the order of `INPUTS`, the last with `depth` only."""
    generator = torch.Generator().manual_seed(seed)
    scene, hypothesis = (
        torch.randint(0, 256, (b, 3, patch_px, patch_px), dtype=torch.uint8, generator=generator) for _ in range(2)
    )
    T = torch.eye(4).repeat(b, 1, 1)
    T[:, :2, 3] = 0.2 * torch.randn(b, 2, generator=generator)
    T[:, 2, 3] = 0.5 + torch.rand(b, generator=generator)
    focal, half = 5.0 * patch_px, 0.5 * patch_px
    K = torch.tensor([[focal, 0.0, half], [0.0, focal, half], [0.0, 0.0, 1.0]]).repeat(b, 1, 1)
    K[:, :2, 2] -= focal * T[:, :2, 3] / T[:, 2:3, 3]  # the patch is centred on the object
    if not depth:
        return scene, hypothesis, T, K
    hills = torch.rand(b, 1, 4, 4, generator=generator)
    relief = nn.functional.interpolate(hills, size=(patch_px, patch_px), mode="bilinear")[:, 0]
    return scene, hypothesis, T, K, torch.where(relief > 0.3, T[:, 2, 3, None, None] + 0.1 * relief, 0.0)


def _differences(network: FlatNetwork, run: Callable[..., Outputs], config: NetworkConfig) -> dict[str, float]:
    worst: dict[str, float] = {}
    for b in CHECKED_BATCHES:
        inputs = random_pairs(b, config.patch_px, seed=b, depth=config.uses_depth)
        with torch.no_grad():
            expected = network(*inputs)
        outputs = run(*inputs)
        for name, tensor in zip(OUTPUTS, expected, strict=False):
            difference = float(np.abs(outputs[name] - tensor.numpy()).max())
            worst[name] = max(worst.get(name, 0.0), difference) if difference == difference else float("nan")
    return worst


def _onnx(network: FlatNetwork, inputs: tuple[Tensor, ...], about: str) -> bytes:
    _require("onnx", "onnxscript", "onnxruntime")
    names = OUTPUTS[: len(network(*inputs))]
    batch = torch.export.Dim("batch", min=1)
    with _quiet():
        program = torch.onnx.export(
            network, inputs, input_names=list(INPUTS[: len(inputs)]), output_names=list(names), opset_version=OPSET,
            dynamo=True, dynamic_shapes=({0: batch},) * len(inputs), verbose=False,
        )  # fmt: skip
    assert program is not None
    model = program.model_proto
    entry = model.metadata_props.add()
    entry.key, entry.value = "refinenet", about
    return bytes(model.SerializeToString())


def _onnx_runner(content: bytes) -> Callable[..., Outputs]:
    import onnxruntime

    session = onnxruntime.InferenceSession(content, providers=["CPUExecutionProvider"])
    names = [output.name for output in session.get_outputs()]

    def run(*inputs: Tensor) -> Outputs:
        fed = {name: tensor.numpy() for name, tensor in zip(INPUTS[: len(inputs)], inputs, strict=True)}
        return dict(zip(names, session.run(None, fed), strict=True))

    return run


def _program(network: FlatNetwork, inputs: tuple[Tensor, ...], about: str) -> bytes:
    batch = torch.export.Dim("batch", min=1)
    with _quiet(), torch.no_grad():
        program = torch.export.export(network, inputs, dynamic_shapes=({0: batch},) * len(inputs))
        buffer = io.BytesIO()
        torch.export.save(program, buffer, extra_files={"refinenet": about})
    return buffer.getvalue()


def _program_runner(content: bytes) -> Callable[..., Outputs]:
    with _quiet():
        module = torch.export.load(io.BytesIO(content)).module()

    def run(*inputs: Tensor) -> Outputs:
        with torch.no_grad():
            outputs = module(*inputs)
        return {name: tensor.numpy() for name, tensor in zip(OUTPUTS, outputs, strict=False)}

    return run


def _about(loaded: Checkpoint) -> dict[str, Any]:
    provenance = loaded.provenance
    return {
        "preset": provenance.config.preset,
        "step": provenance.step,
        "patch_px": provenance.config.network.patch_px,
        "window": posecore_config.to_dict(provenance.config)["window"],
        "pivot": provenance.config.pivot,
        "objects": provenance.objects,
        "camera_fx_px": provenance.camera_fx_px,
        "checkpoint_sha256": loaded.sha256,
    }


def _require(*packages: str) -> None:
    missing = [package for package in packages if importlib.util.find_spec(package) is None]
    if missing:
        raise ConfigError(f"ONNX needs {', '.join(missing)}, not installed here; pip install 'refinenet[export]'")


@contextmanager
def _quiet() -> Iterator[None]:
    """Suppress the exporters' internal warnings."""
    logger = logging.getLogger("torch.onnx")
    before = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logger.setLevel(before)
