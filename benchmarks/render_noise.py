"""Noise against time: error of a Cycles scene by light paths per pixel, with and without Blender's denoiser.

    python benchmarks/render_noise.py --scenes 8

Error is the root mean square difference to 512 paths a pixel, in display levels of 255, over the pixels that objects
cover. One core. The last line is JSON.
"""

import argparse
import json
import statistics
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from posecore.mesh import load_mesh
from synthgen.config import load_config
from synthgen.draw.target import make_target
from synthgen.engine import RenderedScene
from synthgen.image.sensor import display_from_linear
from synthgen.pairs.pair_maker import PairMaker, limit_threads
from synthgen.scene import Scene

REFERENCE_SAMPLES = 512
DENOISERS = {"none": None, "fast": "FAST", "high": "HIGH"}


def display(rendered: RenderedScene) -> np.ndarray:
    """The objects on black in levels."""
    return 255 * display_from_linear(rendered.rgb_linear * rendered.alpha[..., None])


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--object", type=Path, default=Path("examples/objects/tug.ply"), help="mesh in millimetres")
    parser.add_argument("--scenes", type=int, default=8)
    parser.add_argument("--samples", type=int, nargs="+", default=[2, 4, 8, 16, 32])
    parser.add_argument("--rounds", type=int, default=3)
    arguments = parser.parse_args()
    config = load_config("default", (), {"engine": "cycles"})
    limit_threads(1)
    maker = PairMaker(config, [make_target(1, load_mesh(arguments.object, units="mm"), config)], threads=1)
    engine = maker._engines["cycles"]
    render, scenes = engine.render, []

    def recorded(scene: Scene) -> RenderedScene:
        scenes.append(scene)
        return render(scene)

    engine.render = recorded  # type: ignore[method-assign]
    for index in range(arguments.scenes):
        maker.samples(index)
    settings = engine._scene.cycles  # type: ignore[attr-defined]
    references = [display(render(replace(s, samples=REFERENCE_SAMPLES, render_seed=s.render_seed ^ 1))) for s in scenes]
    rows = []
    for denoiser, quality in DENOISERS.items():
        settings.use_denoising = quality is not None
        if quality is not None:
            settings.denoiser, settings.denoising_quality = "OPENIMAGEDENOISE", quality
            settings.denoising_input_passes, settings.denoising_prefilter = "RGB", "NONE"
        for samples in arguments.samples:
            noisy = [replace(s, samples=samples) for s in scenes]
            render(noisy[0])
            took_s, errors = [], []
            for _ in range(arguments.rounds):
                began = time.perf_counter()
                images = [render(s) for s in noisy]
                took_s.append((time.perf_counter() - began) / len(noisy))
            for image, reference in zip(images, references, strict=True):
                covered = image.alpha > 0
                errors.append(float(np.sqrt(np.mean((display(image) - reference)[covered] ** 2))))
            row = {"denoiser": denoiser, "samples": samples, "ms": round(1e3 * statistics.median(took_s), 1)}
            rows.append(row | {"rms_levels": round(statistics.mean(errors), 2)})
            print(
                f"{denoiser:5s} {samples:3d} paths {row['ms']:7.1f} ms  {rows[-1]['rms_levels']:6.2f} levels",
                flush=True,
            )
    maker.close()
    print(json.dumps({"scenes": arguments.scenes, "rows": rows}))


if __name__ == "__main__":
    main()
