"""How long does one iteration take?

Protocol: one pose in each image, one iteration, from the image in memory to the updated pose: rendering the
hypothesis, cutting both patches, the network. The median over images is in `result.json` as `ms_per_iteration`. The
paper: about 25 ms on a GTX 1080.

Weights do not matter for speed, so networks without a shipped checkpoint are trained for two steps only; their poses
mean nothing.

  --smoke  the shipped checkpoints (compact, flow), 2 images: a test of the plumbing
  --small  the same, presets paper and plus, and the baselines, 30 images
  --full   the same with 200 images; a GPU

    python experiments/speed.py --small
"""

import sys
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
from experiments.chain import Step, quoted
from experiments.common import SHIPPED, TUG, Comparison, Experiment, Inputs, Network, compared, main, median_ms

UNTRAINED = "--steps 2 --batch 4 --set validation.pairs=4 --set loader.workers=1 --threads 1"


def plan(work: Path, size: str, inputs: Inputs) -> list[Step]:
    """Commands for a size."""
    networks = {"compact": SHIPPED["shipped"], "flow": SHIPPED["shipped-flow"]}
    if size != "smoke":
        networks["paper"] = Network(train=f"--preset paper --set backbone.pretrained=false {UNTRAINED}")
        networks["plus"] = Network(train=f"--preset plus {UNTRAINED}")
    return compared(
        work,
        Comparison(
            objects=f"--object {quoted(TUG)}",
            scenes=f"--preset linemod --engine raster {inputs.behind()}",
            pairs=128,
            frames={"smoke": 2, "small": 30, "full": 200}[size],
            networks=networks,
            initial="--random-up-to 20 --random-translation 0.2",
            iterations=1,
        ),
    )


def measured(work: Path) -> dict[str, Any]:
    """Median milliseconds of one iteration by method."""
    files = sorted((work / "results").glob("*.csv"))
    return {"ms_per_iteration": {file.stem: median_ms(file) for file in files if file.stem != "initial"}}


EXPERIMENT = Experiment(
    name=Path(__file__).stem,
    doc=__doc__,
    paper={"one iteration": "about 25 ms on a GTX 1080"},
    minutes={
        "smoke": "half a minute on two CPU cores",
        "small": "six minutes on two CPU cores",
        "full": "ten minutes; a GPU",
    },
    plan=plan,
    measured=measured,
)

if __name__ == "__main__":
    main(EXPERIMENT)
