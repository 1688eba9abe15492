"""From frame to frame: how far from the truth is a tracked pose?

Protocol (section 4.2 of the paper, on the four synthetic sequences of Choi and Christensen): each frame starts from the
pose of the one before; root mean squares of the errors along and about each axis. The paper, on the orange juice: 0.65,
0.69 and 6.49 mm, 1.5, 0.68 and 0.39 deg.

Here sequences are rendered. The first frame starts from the truth turned by up to 2 degrees and moved by up to 0.02
diameters; so does a later one whose object was lost in the frames before, which is counted as a reset. Those perturbed
poses of all frames are the row `initial` of the report; a tracker sees no other of them.

  --smoke  the example object, its shipped checkpoints, 1 sequence of 6 images: a test of the plumbing
  --small  the same with 2 sequences of 100 images; nothing is trained
  --full   tug and bobbin, 4 sequences of 1 000 images, one network of preset paper for each loss, 200 000 path-traced
           pairs; a GPU

    python experiments/tracking.py --small
    python experiments/tracking.py --full --backbone-weights inception_v3_stem.safetensors
"""

import json
import sys
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
from experiments.chain import Step, quoted, words
from experiments.common import (
    BOBBIN,
    ON_GPUS,
    SHIPPED,
    TUG,
    Comparison,
    Experiment,
    Inputs,
    full_networks,
    initial_poses,
    joined,
    main,
    rendered_frames,
    report,
    trainings,
)

SEQUENCES = {"smoke": (1, 6), "small": (2, 100), "full": (4, 1000)}


def plan(work: Path, size: str, inputs: Inputs) -> list[Step]:
    """Commands for a size."""
    full, folder = size == "full", quoted(work)
    info = quoted(TUG.with_name("models_info.json"))
    both = f"--object {quoted(TUG)} --object {quoted(BOBBIN)} --models-info {info}"
    what = Comparison(
        objects=both if full else f"--object {quoted(TUG)}",
        scenes=f"--preset choi --engine {'cycles' if full else 'raster'} {inputs.behind()}",
        pairs=200_000,
        networks=full_networks(inputs) if full else SHIPPED,
        workers=8 if full else 2,
        render=ON_GPUS if full else "--workers 2",
    )
    sequences, frames = SEQUENCES[size]
    options = f"{what.scenes} --sequence --sequences {sequences} --workers {what.workers}"
    steps = [
        *trainings(work, what),
        rendered_frames(work, what.objects, options, frames),
        initial_poses(work, "--random-up-to 2 --random-translation 0.02"),
    ]
    for name, network in what.networks.items():
        checkpoint = (
            f"{folder}/run_{name}/best.safetensors" if network.checkpoint is None else quoted(network.checkpoint)
        )
        parts = [f"{name}_{scene:06d}" for scene in range(1, sequences + 1)]
        for scene, part in enumerate(parts, start=1):
            steps.append(
                Step(
                    name=f"track-{part}",
                    why=f"Sequence {scene}, tracked by network '{name}'.",
                    command=words(
                        f"refinenet track --dataset {folder}/test_bop --scene {scene} --checkpoint {checkpoint}"
                        f" --init {folder}/results/initial.csv --name {name} --out {folder}/parts/{part}.csv"
                    ),
                    leaves=f"parts/{part}.csv",
                )
            )
        steps.append(joined(work, name, parts))
    results = " ".join(f"--results {folder}/results/{name}.csv" for name in what.networks)
    dataset = f"--dataset {folder}/test_bop"
    tables = " ".join(f"--out {folder}/tracking.{kind}" for kind in ("md", "json"))
    steps.append(
        Step(
            name="tracking",
            why="Errors by axis, sequence by sequence.",
            command=words(f"evalkit tracking {dataset} {results} {tables}"),
            leaves="tracking.json",
        )
    )
    steps.append(report(work, f"{dataset} --results {folder}/results/initial.csv {results}"))
    return steps


def measured(work: Path) -> dict[str, Any]:
    """The tracking table, and how often each network's track was reset."""
    files = [path for path in (work / "results").glob("*.csv.json") if path.name != "initial.csv.json"]
    resets = {path.name.removesuffix(".csv.json"): json.loads(path.read_text(encoding="utf-8")) for path in files}
    return {
        "tracking": json.loads((work / "tracking.json").read_text(encoding="utf-8")),
        "resets": {name: len(sidecar["resets"]) for name, sidecar in resets.items()},
    }


EXPERIMENT = Experiment(
    name=Path(__file__).stem,
    doc=__doc__,
    paper={"orange juice": "0.65, 0.69, 6.49 mm; 1.5, 0.68, 0.39 deg (root mean squares along and about x, y, z)"},
    minutes={
        "smoke": "half a minute on two CPU cores",
        "small": "a few minutes on two CPU cores",
        "full": "a day, most of it rendering; a GPU",
    },
    plan=plan,
    measured=measured,
)

if __name__ == "__main__":
    main(EXPERIMENT)
