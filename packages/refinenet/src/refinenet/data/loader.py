"""Loader processes, and the transfer of their batches to the device."""

import multiprocessing.util
import os
import shutil
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import torch
from posecore.errors import PoseError
from posecore.processes import interrupts_ignored, one_math_thread
from torch.utils.data import DataLoader, IterableDataset, get_worker_info

from refinenet.batch import Batch
from refinenet.data.pair_stream import PairStream
from refinenet.errors import LoaderError

SHARED_MEMORY = Path("/dev/shm")
"""Shared memory, through which loader processes hand over batches."""


def prepare_worker(threads: int = 1) -> None:
    """Limit a loader process to its own core: software rasteriser, OpenCV and torch each start a thread per core.

    `one_math_thread` at its start does the same for NumPy.
    """
    os.environ["LP_NUM_THREADS"] = str(threads)
    cv2.setNumThreads(threads)
    torch.set_num_threads(threads)


def _init_worker(_: int) -> None:
    prepare_worker()
    # a thread that still hands over a batch at Python's exit would abort the process, and the run with a traceback
    multiprocessing.util.Finalize(None, os._exit, args=(0,), exitpriority=-100)


def require_shared_memory(batch: Batch, in_flight: int) -> None:
    """Require shared memory for the batches in flight: torch would lose a batch and wait for it for ever.

    Raises:
        LoaderError: It is too small; the message gives the size needed.
    """
    if not SHARED_MEMORY.is_dir():
        return
    tensors = (*batch.inputs, *batch.target, batch.sample_ids, batch.visible_fraction, batch.render_colours)
    needed = in_flight * sum(x.nbytes for x in tensors if x is not None)
    size = shutil.disk_usage(SHARED_MEMORY).total  # free memory is already short of the batches of faster processes
    if size < needed:
        enough_gb = max(1, round(2 * needed / 1e9))
        raise LoaderError(
            f"{SHARED_MEMORY}: has {size / 1e6:.0f} MB, the {in_flight} batches that loader processes may have "
            f"ready need {needed / 1e6:.0f} MB; start the container with --shm-size={enough_gb}g, or lower "
            "loader.prefetch or --workers (0 needs none)"
        )


class _InProcess(IterableDataset[Batch]):
    """A stream, iterated in a loader process."""

    def __init__(self, stream: PairStream) -> None:
        super().__init__()
        self._stream = stream

    def __iter__(self) -> Iterator[Batch]:
        batches = iter(self._stream)
        workers = 0 if (info := get_worker_info()) is None else info.num_workers
        on_this_machine = int(os.environ.get("LOCAL_WORLD_SIZE", 1))
        for number, batch in enumerate(batches):
            if number == 0 and workers:
                require_shared_memory(batch, on_this_machine * workers * self._stream.config.loader.prefetch)
            yield batch


@contextmanager
def worker_failures() -> Iterator[None]:
    """Turn the error that torch raises when a loader process dies, from a signal handler, into a `LoaderError`.

    Raises:
        LoaderError: A loader process died.
    """
    try:
        yield
    except RuntimeError as error:
        if not str(error).startswith("DataLoader worker"):
            raise
        raise _worker_failure(str(error).partition(". ")[0].rstrip(".").removeprefix("DataLoader worker ")) from error


def _worker_failure(reason: str) -> LoaderError:
    """The error for a process that died; removes torch's signal handler, which would raise again."""
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    return LoaderError(
        f"a loader process ended: {reason}; where memory is short, fewer --workers or less loader.cache_mb need less, "
        "where /dev/shm is, --shm-size makes it larger; --resume goes on from the last checkpoint, if there is one"
    )


class _Loader(DataLoader[Batch]):
    """A loader that raises the original errors of its processes, without torch's traceback in the message."""

    def __iter__(self) -> Any:
        try:
            with interrupts_ignored(), one_math_thread():
                batches = super().__iter__()
            yield from batches
        except PoseError as error:
            *wrapped, last = str(error).strip().splitlines()
            raise (type(error)(last.partition(": ")[2]) if wrapped else error) from None
        except (ConnectionError, EOFError) as error:  # from the pipe of a killed process
            raise _worker_failure("its pipe broke") from error


def make_loader(stream: PairStream, *, pin: bool = False) -> DataLoader[Batch]:
    """A loader of the stream's batches; processes are spawned, since a GL context does not survive a fork.

    Args:
        stream: Stream of batches.
        pin: Put batches into page-locked memory, from which a GPU copies them while it computes.
    """
    loader = stream.config.loader
    if loader.workers == 0:
        return _Loader(stream, batch_size=None, pin_memory=pin)
    return _Loader(
        _InProcess(stream),
        batch_size=None,
        pin_memory=pin,
        num_workers=stream.workers,
        prefetch_factor=loader.prefetch,
        multiprocessing_context="spawn",
        worker_init_fn=_init_worker,
    )


def on_device(batches: Iterator[Batch], device: torch.device) -> Iterator[Batch]:
    """Batches on a device; a GPU copies each while it still computes the previous step."""
    if device.type != "cuda":
        yield from (batch.to(device) for batch in batches)
        return
    side = torch.cuda.Stream(device)
    for batch in batches:
        with torch.cuda.stream(side):
            there = batch.to(device)
        main = torch.cuda.current_stream(device)
        main.wait_stream(side)
        for tensor in (*there.inputs, *there.target):
            if tensor is not None:
                tensor.record_stream(main)  # allocated on the other stream: its memory must not be reused too early
        yield there
