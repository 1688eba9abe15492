"""How many hypotheses should share one rendered scene, for the same time of rendering?

    python benchmarks/hypotheses_per_scene.py --scene-ms 160 --pair-ms 9 --budget-s 400 --steps 2500

More hypotheses on a scene make pairs cheap and scenes few. Each setting gets the pairs that the same number of core
seconds buys at the given costs of a scene and of a pair (measured by render_throughput.py), a `compact` network is
trained on them as they are stored, for the same number of steps, and measured on pairs of other scenes (one hypothesis
each, another seed). The images themselves are drawn by the rasteriser at the network's patch size, so that the
benchmark takes minutes. The last line is JSON.
"""

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from refinenet.config import TrainConfig, load_config
from refinenet.data.objects import load_models, object_points
from refinenet.data.pair_stream import PairSource
from refinenet.data.split import Split, spread_rows
from refinenet.data.validation_set import validation_batches
from refinenet.device import choose_device
from refinenet.geometry.symmetry import ObjectPoints
from refinenet.models import checkpoint
from refinenet.training import validation
from refinenet.training.loop import train

PATCH_PX = 64
TEST_PAIRS = 1024


def render(arguments: argparse.Namespace, out: Path, n: int, count: int, seed: int) -> None:
    """Render pairs with `count` hypotheses a scene."""
    command = [sys.executable, "-m", "synthgen.cli", "render", "--object", str(arguments.object), "--out", str(out)]
    command += [
        "--n",
        str(n),
        "--seed",
        str(seed),
        "--engine",
        "raster",
        "--test-images",
        "0",
        "--quiet",
        "--preset",
        arguments.preset,
    ]
    command += ["--set", f"patch_px={PATCH_PX}", "--set", "window.min_area_px=60", "--set", "shard_size=64"]
    subprocess.run([*command, "--hypotheses-per-scene", str(count)], check=True)


def measure(config: TrainConfig, run: Path, test: Path) -> dict[str, float]:
    """Errors of the run's last network on the test pairs."""
    source = PairSource(str(test), config, training=False)
    reader, frames = source.reader, source.frames
    rows = {shard_id: np.arange(reader.n_samples(shard_id)) for shard_id in reader.committed}
    split = spread_rows(Split(rows=rows, scenes=reader.n), TEST_PAIRS)
    objects: ObjectPoints = object_points(
        frames.meshes, frames.models(load_models(reader)), config.loss.model_points, config.loss.symmetry_step_deg
    )
    network = checkpoint.load(run / "last.safetensors").network()
    device = choose_device("cpu")
    errors = validation.measure(network, validation_batches(source, split, config.batch), objects, device, config.loss)
    source.close()
    return {name.removeprefix("validation/"): round(value, 3) for name, value in errors.items()}


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--object", type=Path, default=Path("examples/objects/tug.ply"), help="mesh in millimetres")
    parser.add_argument("--preset", default="default", help="synthgen preset of the pairs")
    parser.add_argument("--counts", type=int, nargs="+", default=[1, 4, 8, 16])
    parser.add_argument("--scene-ms", type=float, required=True, help="core time of a scene's render")
    parser.add_argument("--pair-ms", type=float, required=True, help="core time of the rest of a pair")
    parser.add_argument("--budget-s", type=float, default=400.0, help="core seconds of rendering for each setting")
    parser.add_argument("--steps", type=int, default=2500)
    parser.add_argument("--threads", type=int, default=1)
    arguments = parser.parse_args()
    changes = ["hypothesis.online=false", f"steps={arguments.steps}", f"validation.every={arguments.steps}"]
    changes += [f"threads={arguments.threads}", "validation.scene_fraction=0.02"]
    config = load_config("compact", changes)
    results = []
    with tempfile.TemporaryDirectory() as folder:
        test = Path(folder) / "test"
        render(arguments, test, TEST_PAIRS, 1, seed=1)
        for count in arguments.counts:
            scenes = int(1e3 * arguments.budget_s / (arguments.scene_ms + count * arguments.pair_ms))
            shards, run = Path(folder) / f"shards_{count}", Path(folder) / f"run_{count}"
            render(arguments, shards, scenes * count, count, seed=0)
            train(config, str(shards), run)
            errors = measure(config, run, test)
            results.append({"hypotheses_per_scene": count, "scenes": scenes, "pairs": scenes * count, **errors})
            print(
                f"{count:3d} hypotheses a scene: {scenes} scenes, {scenes * count} pairs, "
                f"rotation {errors['rotation_before_deg']:.2f} -> {errors['rotation_after_deg']:.2f} deg, "
                f"distance {errors['add_before_mm']:.2f} -> {errors['add_after_mm']:.2f} mm",
                flush=True,
            )
    print(json.dumps({"budget_s": arguments.budget_s, "steps": arguments.steps, "results": results}))


if __name__ == "__main__":
    main()
