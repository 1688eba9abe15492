"""Loader processes that die or find no room for their batches end the run with a line."""

import os
import shutil
import signal
from collections import namedtuple

import pytest
import torch
from posecore.errors import PoseError
from posecore.shard import ShardReader
from refinenet.data import loader
from refinenet.errors import LoaderError
from refinenet.training.loop import train

from ..training.test_training import small
from .test_pair_stream import make_stream, split_by_scene


def test_batches_that_shared_memory_cannot_hold_are_refused(dataset, monkeypatch):
    batch = next(iter(make_stream(dataset, split_by_scene(ShardReader(str(dataset)), 0.2, 0)[0])))
    held = sum(x.nbytes for x in (*batch.inputs, *batch.target) if x is not None)
    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage(4.5 * held, 0, 0))
    loader.require_shared_memory(batch, 4)
    with pytest.raises(PoseError, match=r"has \d+ MB, the 5 batches .* --shm-size=1g, or lower loader.prefetch"):
        loader.require_shared_memory(batch, 5)


@pytest.mark.slow
def test_a_loader_process_that_is_killed_ends_in_one_line(dataset, tmp_path):
    """As the kernel does where memory is short."""

    def kill(step, _):
        if step == 2:
            for process in torch.multiprocessing.active_children():
                os.kill(process.pid, signal.SIGKILL)

    with pytest.raises(LoaderError, match=r"a loader process ended: .*; where memory is short"):
        train(small("loader.workers=1", "steps=40"), str(dataset), tmp_path, report=kill)
