"""What goes wrong in workers: crashes, hangs, growth, and scenes that are to blame for it."""

import ctypes
import faulthandler
import functools
import json
import logging
import os
import signal
import sys
from collections import Counter
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import children
import cloudpickle
import numpy as np
import pytest
from distributed import Client
from posecore.errors import RenderError
from posecore.shard import ShardReader, ShardWriter
from synthgen.engines.blender import scratch
from synthgen.inputs.assets import Assets
from synthgen.pairs import data_card
from synthgen.pairs.pair_maker import concatenate
from synthgen.run import dispatcher, worker
from synthgen.run.shard_job import REPLACEMENT_ATTEMPT, ShardJob, ShardRenderer
from synthgen.run.worker import RendererPlugin

cloudpickle.register_pickle_by_value(sys.modules[__name__])  # workers cannot import a test module

N = 14
SEGFAULT, HANG, FAILURE = 2, 3, 5  # scenes, two to a shard


class PoisonedRenderer(ShardRenderer):
    """Some scenes crash, fail or hang with Python's lock held, unless another draw takes their place."""

    def _maker(self):
        maker = super()._maker()
        return SimpleNamespace(samples=functools.partial(self.samples, maker))

    def samples(self, maker, scene_index, keep, first_attempt):
        _, remove = scratch.make_folder()  # as Blender's engine has one
        if first_attempt == 0:
            self.misbehave(scene_index)
        remove()
        return maker.samples(scene_index, keep, first_attempt)

    def misbehave(self, scene_index):
        if scene_index == SEGFAULT:
            os.kill(os.getpid(), signal.SIGSEGV)
        if scene_index == FAILURE:
            raise RenderError("Blender failed")
        if scene_index == HANG:
            # Its time limit runs out at once; one short enough to wait for would hit other scenes on a busy machine.
            with Path(os.devnull).open("w") as nowhere:
                faulthandler.dump_traceback_later(0.2, exit=True, file=nowhere)
                ctypes.PyDLL(None).pause()


HANGS = """
import ctypes
from synthgen.run.worker import _killed_after
with _killed_after(0.2):
    print("begun", flush=True)
    ctypes.PyDLL(None).pause()
"""


class AllFail(PoisonedRenderer):
    def misbehave(self, scene_index):
        raise RenderError("no scene renders")


class Growing(PoisonedRenderer):
    """Keeps memory with every shard, and writes down which process rendered it."""

    log: Path

    def __init__(self, job):
        super().__init__(job)
        self.kept = []

    def misbehave(self, scene_index):
        self.kept.append(np.ones(60 << 20, np.uint8))
        with self.log.open("a") as file:
            file.write(f"{os.getpid()}\n")


def with_renderer(renderer, monkeypatch, **attributes):
    """Have workers render with another renderer."""

    class Plugin(RendererPlugin):
        def setup(self, worker):
            super().setup(worker)
            self.renderer = renderer(self.job)
            for name, value in attributes.items():
                setattr(self.renderer, name, value)

    monkeypatch.setattr(dispatcher, "RendererPlugin", Plugin)


@pytest.fixture
def job_and_writer(tmp_path, tug, config_of):
    config = config_of()
    writer = ShardWriter.create(str(tmp_path / "shards"), data_card.rendered_card(config, N, {1: tug}, Assets()))
    return ShardJob(config=config, card=writer.card, meshes={1: tug}, threads=1), writer


def run(job, writer, **settings):
    dispatcher.run(job, writer, **{"workers": 1, "scheduler": None, "on_shard": lambda encoded: None, **settings})


@pytest.mark.slow
def test_scenes_that_crash_fail_or_hang_are_replaced_and_said(job_and_writer, monkeypatch, caplog, maker_of):
    job, writer = job_and_writer
    with_renderer(PoisonedRenderer, monkeypatch)
    caplog.set_level(logging.WARNING, "synthgen")
    run(job, writer)
    poisoned = {SEGFAULT, FAILURE, HANG}
    assert writer.quarantined() == sorted(poisoned)
    lines = [json.loads(line) for line in Path(writer.url, "manifest.jsonl").read_text().splitlines()]
    assert {line["shard"]: line["quarantined"] for line in lines if "quarantined" in line} == {1: [2, 3], 2: [5]}
    assert sum("quarantined" in record.message for record in caplog.records) == 3
    reader, maker = ShardReader(writer.url), maker_of()
    assert reader.complete
    for shard_id in (0, 1):
        scenes = [2 * shard_id, 2 * shard_id + 1]
        firsts = [REPLACEMENT_ATTEMPT if scene in poisoned else 0 for scene in scenes]
        expected = concatenate([maker.samples(s, 2, first) for s, first in zip(scenes, firsts, strict=True)])
        found = reader.read(shard_id)
        assert np.array_equal(found["T_cam_obj"], expected["T_cam_obj"])
        assert np.array_equal(found["scene_rgb"], expected["scene_rgb"])
        assert (found["rejected"].reshape(2, 2) >= np.array(firsts)[:, None]).all()


def test_a_process_that_hangs_with_pythons_lock_held_is_killed():
    ended = children.run([sys.executable, "-c", HANGS])
    assert (ended.returncode, ended.stdout) == (1, "begun\n")
    assert "Traceback" not in ended.stderr


class Noting(ShardRenderer):
    """Stands for a renderer, and notes under which time limits it works."""

    def __init__(self, limits):
        self.limits, self.noted = limits, []

    def prepare(self):
        self.noted.append(("prepare", *self.limits))

    def render(self, shard_id, quarantined):
        self.noted.append(("render", *self.limits))

    def scene(self, shard_id, scene, quarantined):
        self.noted.append(("scene", *self.limits))


def test_both_tasks_work_within_the_time_limit_of_the_job(monkeypatch, config_of, tmp_path):
    limits = []

    @contextmanager
    def noted_limit(timeout_s):
        limits.append(timeout_s)
        yield
        limits.pop()

    plugin = RendererPlugin(ShardJob(config=config_of(), card={}, meshes={}))
    plugin.renderer = renderer = Noting(limits)
    memory = SimpleNamespace(memory_limit=None)
    here = SimpleNamespace(plugins={plugin.name: plugin}, memory_manager=memory, nanny=None)
    monkeypatch.setattr(worker, "get_worker", lambda: here)
    monkeypatch.setattr(worker, "Event", lambda mark: SimpleNamespace(set=lambda: None))
    monkeypatch.setattr(worker, "_killed_after", noted_limit)

    def submit(task, *arguments, **settings):
        task(*arguments)
        return SimpleNamespace(add_done_callback=lambda callback: None)

    client, writer = Mock(spec=Client, submit=submit), Mock(spec=ShardWriter)
    dispatching = dispatcher.Dispatcher(client, plugin, writer, lambda encoded: None, shard_timeout_s=7.0)
    for scene in (None, 6):
        dispatching._submit(dispatcher._Shard(id=3), scene)
    assert renderer.noted == [("prepare", 7.0), ("render", 7.0), ("prepare", 7.0), ("scene", 7.0)]


@pytest.mark.slow
def test_a_renderer_that_always_fails_stops_the_run(job_and_writer, monkeypatch):
    job, writer = job_and_writer
    with_renderer(AllFail, monkeypatch)
    with pytest.raises(RenderError, match=r"fails at more than 3 of 7 scenes.*no scene renders"):
        run(job, writer)
    assert writer.committed() == []


@pytest.mark.slow
def test_a_worker_that_grows_is_replaced_between_shards(job_and_writer, monkeypatch, tmp_path, caplog):
    job, writer = job_and_writer
    monkeypatch.setattr(dispatcher.cluster, "memory_limit_bytes", lambda workers: 800 << 20)  # a quarter may be grown
    with_renderer(Growing, monkeypatch, log=tmp_path / "pids")
    run(job, writer)
    assert ShardReader(writer.url).complete
    pids = Counter((tmp_path / "pids").read_text().split())
    assert len(pids) >= 2
    assert sum(pids.values()) == 7  # no scene was rendered twice
