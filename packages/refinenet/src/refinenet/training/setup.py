"""Assembly of a training run from its configuration."""

import logging
from pathlib import Path

import torch
from torch import nn

from refinenet.config import TrainConfig
from refinenet.device import choose_device
from refinenet.models import checkpoint, inception
from refinenet.models.networks import PaperNet, make_network
from refinenet.training.losses import make_loss
from refinenet.training.optimiser import EmaWeights, make_optimiser
from refinenet.training.ranks import Ranks
from refinenet.training.resume import load_run, restore
from refinenet.training.run import Trainer
from refinenet.training.training_data import open_data

log = logging.getLogger(__name__)


def open_run(config: TrainConfig, url: str, out: Path, *, resume: bool = False) -> Trainer:
    """A run, ready to step; under torchrun, within `process_group`.

    Args:
        config: Configuration.
        url: Shard dataset.
        out: Folder of checkpoints and logs.
        resume: Continue from `out/last.safetensors`.

    Raises:
        ConfigError: Settings and data do not fit.
        CheckpointError: There is nothing to resume, or it is of another run.
        ShardError: The dataset is damaged, of another schema, or empty.
    """
    if config.threads:
        torch.set_num_threads(config.threads)
    torch.manual_seed(config.seed)
    torch.backends.cudnn.deterministic, torch.backends.cudnn.benchmark = True, False
    ranks, device = Ranks.of_environment(), choose_device(config.device)
    saved = load_run(config, out) if resume else None
    if saved is not None:
        config = saved.config
    joined = saved.validation_shards if saved else ()
    data = open_data(config, url, out, ranks, resume=resume, validation_shards=joined)
    network = build_network(config, device, pretrained=saved is None)
    decay = config.optimiser.ema_decay
    run = Trainer(
        config,
        out,
        data=data,
        network=network,
        loss=make_loss(config.loss, data.points.to(device)),
        optimiser=make_optimiser(network, config.optimiser),
        ema=EmaWeights(network, decay) if decay else None,
        ranks=ranks,
        device=device,
    )
    if saved is not None:
        restore(run, saved)
    return run


def build_network(config: TrainConfig, device: torch.device, *, pretrained: bool) -> nn.Module:
    """The network on a device, with random weights.

    Args:
        config: Configuration of the run.
        device: Where it runs.
        pretrained: Load the weights that a new run begins with: those of the checkpoint `config.init`, or ImageNet
            weights of the stem.

    Raises:
        ConfigError: ImageNet weights cannot be downloaded.
        CheckpointError: The checkpoint or the weights do not fit the network.
    """
    network: nn.Module = make_network(config.network).to(device, memory_format=torch.channels_last)  # type: ignore[call-overload]
    if pretrained and config.init:
        loaded = checkpoint.load(Path(config.init))
        loaded.give_weights(network, config.network)
        if (before := loaded.provenance.config.pivot) != config.pivot:
            log.warning(
                "%s: its updates are about the %s of meshes, and this run's about the %s: where these lie apart, it "
                "has to learn them anew; --set pivot=%s keeps them",
                config.init, before, config.pivot, before,
            )  # fmt: skip
    elif pretrained and isinstance(network, PaperNet) and config.network.backbone.pretrained:
        stem = config.network.backbone
        inception.load_pretrained(network.stem, stem.name, stem.weights)
    return network
