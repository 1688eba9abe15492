"""Throughput of `synthgen render`, time of a pair by stage, constancy over a long run, and a comparison with a peer.

    python benchmarks/render_throughput.py --engine raster
    python benchmarks/render_throughput.py --engine cycles --flat-scenes 2500
    python benchmarks/render_throughput.py --engine cycles --blenderproc DIR --blenderproc-python PYTHON --rounds 3
    python benchmarks/render_throughput.py --engine raster --object ../shared/data/lmo/models \\
        --occluders ../shared/data/lmo/models --hypotheses 1 --hypotheses 8 --against e32e377 --pairs 384

Throughput is measured on the command with all its workers, from the first shard on disk to the last. Stages are
measured in this process, on one core. `--object` and `--occluders` take what the command takes. With `--against`
another commit of this repository renders the same, in turn with this one, in the same rounds. With `--blenderproc` (a
source checkout of BlenderProc and a Python that has bpy 4.2 and BlenderProc's packages) the peer renders the same mesh
at the same side, distances and samples per pixel in turn with ours: one scene and one hypothesis image a pair, depth
and segmentation with both, with its default denoiser and with none, on all cores. It renders no occluders, background,
contours or distance transforms and writes no file. The last line is JSON.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import psutil
from other_commit import Environment, packages_of
from posecore import shard
from posecore.camera import Camera
from posecore.mesh import Mesh
from synthgen.config import SynthConfig, load_config
from synthgen.draw.target import make_target, make_targets
from synthgen.inputs.assets import Assets
from synthgen.inputs.sources import Sources
from synthgen.pairs import data_card
from synthgen.pairs.pair_maker import PairMaker, concatenate, limit_threads
from synthgen.run.render import RenderJob, shard_job

Fields = dict[str, Any]


class Stopwatch:
    """Adds up the time spent in wrapped methods."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    def wrap(self, owner: Any, method: str, stage: str) -> None:
        """Replace a bound method by one that is timed."""
        inner: Callable[..., Any] = getattr(owner, method)
        self.seconds[stage] = 0.0

        def timed(*arguments: Any, **keywords: Any) -> Any:
            began = time.perf_counter()
            try:
                return inner(*arguments, **keywords)
            finally:
                self.seconds[stage] += time.perf_counter() - began

        setattr(owner, method, timed)


def stages(config: SynthConfig, meshes: dict[int, Mesh], assets: Assets, scenes: int) -> Fields:
    """Milliseconds a pair by stage, one process, one thread."""
    limit_threads(1)
    scenes = max(scenes, scenes_per_shard(config))  # encoding is timed on whole shards
    maker = PairMaker(config, make_targets(meshes, config, assets), assets, threads=1)
    card = data_card.rendered_card(config, config.shard_size, meshes, assets)
    for scene in range(3 * len(meshes)):  # loads, compiles
        maker.samples(10_000_000 + scene)
    watch = Stopwatch()
    watch.wrap(maker, "accepted_scene", "draw")
    watch.wrap(maker, "_hypotheses", "hypotheses")
    watch.wrap(maker._engines[config.engine], "render", "render")
    watch.wrap(maker, "_render", "render, background, sensor")
    watch.wrap(maker, "_sample", "labels")
    began = time.perf_counter()
    done = [maker.samples(scene) for scene in range(scenes)]
    total = time.perf_counter() - began
    pairs = scenes * config.hypotheses_per_scene
    shards = [concatenate(done[i : i + scenes_per_shard(config)]) for i in range(0, scenes, scenes_per_shard(config))]
    began = time.perf_counter()
    whole = [s for s in shards if len(s["obj_id"]) == config.shard_size]
    size = sum(
        len(data) for i, s in enumerate(whole) for data in shard.encode({**card, "n": 10**9}, i, s).files.values()
    )
    encode = (time.perf_counter() - began) / (len(whole) * config.shard_size)
    maker.close()
    stage_ms = {name: 1e3 * seconds / pairs for name, seconds in watch.seconds.items()}
    stage_ms["background, sensor"] = stage_ms.pop("render, background, sensor") - stage_ms["render"]
    stage_ms["other"] = 1e3 * total / pairs - sum(stage_ms.values())
    stage_ms["encode"] = 1e3 * encode
    return {
        "ms_per_pair": {name: round(value, 3) for name, value in stage_ms.items()},
        "ms_per_pair_in_all": round(sum(stage_ms.values()), 3),
        "bytes_per_pair": size // (len(whole) * config.shard_size),
    }


def scenes_per_shard(config: SynthConfig) -> int:
    """Scenes in a full shard."""
    return config.shard_size // config.hypotheses_per_scene


def throughput(arguments: argparse.Namespace, command: list[str], environment: Environment | None = None) -> float:
    """Pairs per second of the command, from its first shard to its last."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "shards"
        process = subprocess.Popen(
            [*command, "--n", str(arguments.pairs), "--workers", str(arguments.workers), "--out", str(out), "--quiet"],
            stderr=subprocess.PIPE,
            text=True,
            env=environment,
        )
        commits: list[tuple[float, int]] = []
        manifest = out / "manifest.jsonl"
        while process.poll() is None:
            count = 0
            if manifest.is_file():
                count = sum(json.loads(line)["n"] for line in manifest.read_text().splitlines())
            if count and (not commits or count > commits[-1][1]):
                commits.append((time.perf_counter(), count))
            time.sleep(0.02)
        if process.returncode:
            assert process.stderr is not None
            sys.exit(process.stderr.read())
    # the first shards of all workers come together: the clock starts at the last one
    first = commits[min(arguments.workers, len(commits) - 1) - 1]
    rate: float = (commits[-1][1] - first[1]) / (commits[-1][0] - first[0])
    return rate


def flatness(config: SynthConfig, meshes: dict[int, Mesh], assets: Assets, scenes: int) -> Fields:
    """Time per scene and memory of a process at the beginning and at the end of many scenes."""
    limit_threads(1)
    maker = PairMaker(config, make_targets(meshes, config, assets), assets, threads=1)
    process, h = psutil.Process(), config.hypotheses_per_scene
    seconds, cpu_s, rss = [], [], []
    for scene in range(scenes):
        began, cpu_began = time.perf_counter(), time.process_time()
        maker.samples(scene)
        seconds.append(time.perf_counter() - began)
        cpu_s.append(time.process_time() - cpu_began)  # hardly affected by other work on the machine
        rss.append(process.memory_info().rss)
    maker.close()
    start, span = -(-100 // h), max(1, scenes // 10)
    early, late = seconds[start : start + span], seconds[-span:]
    tenths = [seconds[i : i + span] for i in range(0, scenes - span + 1, span)]
    return {
        "scenes": scenes,
        "pairs": scenes * h,
        "scene_ms_from_pair_100": round(1e3 * statistics.median(early), 2),
        "scene_ms_at_the_end": round(1e3 * statistics.median(late), 2),
        "scene_cpu_ms_from_pair_100": round(1e3 * statistics.median(cpu_s[start : start + span]), 2),
        "scene_cpu_ms_at_the_end": round(1e3 * statistics.median(cpu_s[-span:]), 2),
        "scene_ms_by_tenth": [round(1e3 * statistics.median(part), 2) for part in tenths],
        "end_over_start": round(statistics.median(late) / statistics.median(early), 3),
        "memory_growth_mb_from_pair_100": round((rss[-1] - rss[start]) / 1e6, 1),
    }


def peer(arguments: argparse.Namespace, config: SynthConfig, mesh: Mesh, denoiser: str) -> float:
    """Seconds per pair of BlenderProc."""
    camera: Camera = config.camera.camera()
    side_px = make_target(1, mesh, config).window_side_px
    near_m, far_m = config.distance.range_m(mesh.diameter_m)
    command = [arguments.blenderproc_python, str(Path(__file__).with_name("blenderproc_pairs.py"))]
    command += ["--mesh", str(arguments.object.resolve()), "--side", str(config.patch_px)]
    command += ["--diameter", str(mesh.diameter_m * 1e3), "--samples", str(config.samples)]
    command += ["--focal", str(float(camera.K[0, 0]) * config.patch_px / side_px)]
    command += ["--distance", str(near_m / mesh.diameter_m), str(far_m / mesh.diameter_m)]
    command += ["--pairs", str(arguments.peer_pairs), "--denoiser", denoiser]
    settings = {"USE_EXTERNAL_BPY_MODULE": "1", "PYTHONPATH": str(arguments.blenderproc.resolve())}
    done = subprocess.run(command, env={**os.environ, **settings}, capture_output=True, text=True, check=False)
    lines = [line for line in done.stdout.splitlines() if line.startswith('{"s_per_pair"')]
    if done.returncode or not lines:
        sys.exit(f"BlenderProc failed:\n{done.stdout[-2000:]}\n{done.stderr[-2000:]}")
    return float(json.loads(lines[-1])["s_per_pair"])


def main() -> None:
    """Measure and print."""
    arguments = parse()
    environment = packages_of(arguments.against)
    with environment as before:
        for hypotheses in arguments.hypotheses or [None]:
            measure(arguments, hypotheses, before)


def parse() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--object", type=Path, default=Path("examples/objects/tug.ply"), help="mesh or folder, in mm")
    parser.add_argument("--occluders", type=Path, help="mesh or folder, in mm")
    parser.add_argument("--engine", default="cycles", choices=["cycles", "eevee", "raster"])
    parser.add_argument("--preset", default="default")
    parser.add_argument("--set", dest="overrides", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--hypotheses", type=int, action="append", help="hypotheses a scene; repeatable")
    parser.add_argument("--against", metavar="COMMIT", help="measure this commit too")
    parser.add_argument("--pairs", type=int, default=1536, help="pairs of a throughput run")
    parser.add_argument("--workers", type=int, default=len(os.sched_getaffinity(0)))
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--stage-scenes", type=int, default=64)
    parser.add_argument("--flat-scenes", type=int, default=0, help="also render this many scenes in one process")
    parser.add_argument("--blenderproc", type=Path, metavar="DIR")
    parser.add_argument("--blenderproc-python", metavar="PYTHON")
    parser.add_argument("--peer-pairs", type=int, default=20)
    arguments = parser.parse_args()
    if (arguments.blenderproc is None) != (arguments.blenderproc_python is None):
        parser.error("--blenderproc and --blenderproc-python go together")
    if arguments.blenderproc is not None and not arguments.object.is_file():
        parser.error("--blenderproc renders one mesh; give a file as --object")
    return arguments


def measure(arguments: argparse.Namespace, hypotheses: int | None, before: Environment | None) -> None:
    """Measure and print one number of hypotheses a scene, by default the preset's."""
    overrides = [*arguments.overrides, *([] if hypotheses is None else [f"hypotheses_per_scene={hypotheses}"])]
    config = load_config(arguments.preset, overrides, {"engine": arguments.engine})
    sources = Sources(objects=(arguments.object,), occluders=arguments.occluders)
    loaded = shard_job(
        RenderJob(out="", n=arguments.pairs, config=config, sources=sources)
    )  # as the command draws them
    meshes, assets = dict(loaded.meshes), loaded.assets
    command = [sys.executable, "-m", "synthgen.cli", "render", "--object", str(arguments.object)]
    command += [] if arguments.occluders is None else ["--occluders", str(arguments.occluders)]
    command += ["--engine", arguments.engine, "--preset", arguments.preset]
    command += [part for override in overrides for part in ("--set", override)]
    rates: list[float] = []
    earlier: list[float] = []
    peers: dict[str, list[float]] = {"none": [], "default": []}
    for _ in range(arguments.rounds):
        rates.append(throughput(arguments, [*command, "--test-images", "0"]))
        print(f"synthgen, {arguments.workers} workers: {rates[-1]:.1f} pairs/s", flush=True)
        if before is not None:
            earlier.append(throughput(arguments, command, before))
            print(f"synthgen of {arguments.against}: {earlier[-1]:.1f} pairs/s", flush=True)
        if arguments.blenderproc is not None:
            for denoiser, seconds in peers.items():
                seconds.append(peer(arguments, config, next(iter(meshes.values())), denoiser))
                print(f"BlenderProc, denoiser {denoiser}: {seconds[-1]:.3f} s a pair", flush=True)
    result: Fields = {
        "object": str(arguments.object),
        "faces": sum(len(mesh.faces) for mesh in meshes.values()) // len(meshes),
        "engine": config.engine,
        "patch_px": config.patch_px,
        "samples": config.samples,
        "hypotheses_per_scene": config.hypotheses_per_scene,
        "workers": arguments.workers,
        "pairs_per_s": round(statistics.median(rates), 2),
        "pairs_per_s_all": [round(rate, 2) for rate in rates],
    }
    if before is not None:
        result[f"pairs_per_s_{arguments.against}"] = [round(rate, 2) for rate in earlier]
        result[f"times_{arguments.against}"] = round(float(np.median(np.divide(rates, earlier))), 2)
    if arguments.blenderproc is not None:
        for denoiser, seconds in peers.items():
            result[f"blenderproc_{denoiser}_s_per_pair"] = round(statistics.median(seconds), 4)
            ratios = np.multiply(seconds, rates)
            result[f"times_blenderproc_{denoiser}"] = round(float(np.median(ratios)), 1)
    if arguments.stage_scenes:
        result |= stages(config, meshes, assets, arguments.stage_scenes)
        for name, value in result["ms_per_pair"].items():
            print(f"{name:24s} {value:8.3f} ms a pair")
    if arguments.flat_scenes:
        result["flat"] = flatness(config, meshes, assets, arguments.flat_scenes)
    print(json.dumps(result))


if __name__ == "__main__":
    main()
