"""How far from the truth may a start be? Convergence from rotated and from moved starts.

Protocol (section 4.1 and figure 4 of the paper, on LINEMOD): every true pose is rotated by 5 to 45 degrees, or moved
by 0 to 1 diameters, and refined in 10 iterations; the curves are shares of poses within error bounds, and of poses
that diverged (more than 45 degrees or half a diameter away at the end). The paper: benchvise at 45 degrees ends under
5 degrees in more than 60 % of cases and under 10 degrees in more than 80 %, less than 1 % diverge; the ape ends under
10 degrees in about half of them.

Here test images are rendered, scenes that no network was trained on.

  --smoke  the example object, one shipped checkpoint, edge ICP, 1 image, 3 starts: a test of the plumbing
  --small  the example object, its shipped checkpoints, every method without a network, 24 images; nothing is trained
  --full   LM-O's meshes (--data), a network of preset paper for each loss and object as in the paper, 200 000
           path-traced pairs each, 100 images an object; a GPU

    python experiments/perturbation_curves.py --small
    python experiments/perturbation_curves.py --full --data lmo --backbone-weights inception_v3_stem.safetensors
"""

import json
import sys
from pathlib import Path
from typing import Any

from refinenet.refine.registry import BASELINES

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
from experiments.chain import Step, quoted
from experiments.common import (
    SHIPPED,
    TUG,
    Comparison,
    Experiment,
    Inputs,
    compared,
    lmo_comparison,
    main,
)

FRAMES = {"smoke": 1, "small": 24, "full": 800}
PROTOCOL = "--protocol paper"


def plan(work: Path, size: str, inputs: Inputs) -> list[Step]:
    """Commands for a size."""
    if size == "full":
        return compared(work, lmo_comparison(inputs, FRAMES[size], PROTOCOL, iterations=10))
    return compared(
        work,
        Comparison(
            objects=f"--object {quoted(TUG)}",
            scenes=f"--preset quickstart --engine raster {inputs.behind()}",
            frames=FRAMES[size],
            networks={"shipped": SHIPPED["shipped"]} if size == "smoke" else SHIPPED,
            baselines=("edge-icp",) if size == "smoke" else tuple(BASELINES),
            initial="--angles 15,45 --translations 0.2" if size == "smoke" else PROTOCOL,
            iterations=10,
        ),
    )


def measured(work: Path) -> dict[str, Any]:
    """The curves of every method."""
    files = json.loads((work / "report" / "summary.json").read_text(encoding="utf-8"))["files"]
    return {"curves": {file["name"]: file["by_level"] for file in files}}


EXPERIMENT = Experiment(
    name=Path(__file__).stem,
    doc=__doc__,
    paper={
        "benchvise, 45 degrees": "over 60 % under 5 degrees, over 80 % under 10 degrees, under 1 % diverged",
        "ape, 45 degrees": "about half under 10 degrees",
    },
    minutes={
        "smoke": "half a minute on two CPU cores",
        "small": "twenty minutes on two CPU cores, most of it search",
        "full": "days, most of them rendering; a GPU",
    },
    plan=plan,
    measured=measured,
)

if __name__ == "__main__":
    main(EXPERIMENT)
