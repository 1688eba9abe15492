"""A category instead of an object: train on many members, refine one that was never seen.

Protocol (section 4.4 of the paper): one network, trained on all members of a set of cups, mugs and a bowl, then used
on an unseen one. The paper shows it in pictures, without figures.

Here `experiments/cups.py` makes the members, and one mug more that appears in test images only. `category=true` says
that the network is meant for others than its training objects. Starts are the truth turned by 0 to 20 degrees and moved
by 0 to 0.2 diameters.

  --smoke  3 members, 16 training steps: a test of the plumbing
  --small  8 members, preset compact with the contour loss and as it is, 3 000 rasterised pairs, 1 500 steps, 60 images
  --full   the same members, preset paper with each loss, 200 000 path-traced pairs, 100 000 steps, 1 000 images; a GPU

    python experiments/category_level.py --small
    python experiments/category_level.py --full --backbone-weights inception_v3_stem.safetensors
"""

import sys
from dataclasses import replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
from experiments.chain import ROOT, Step, quoted, words
from experiments.common import (
    TRAINED_MINUTES,
    Experiment,
    Inputs,
    compared,
    full_networks,
    main,
    small_networks,
    trained_comparison,
)

TRAINING = {
    "smoke": "--steps 16 --batch 8 --set validation.pairs=16 --threads 1",
    "small": "--steps 1500 --threads 1",
}


def plan(work: Path, size: str, inputs: Inputs) -> list[Step]:
    """Commands for a size."""
    full, count = size == "full", 3 if size == "smoke" else 8
    chosen = full_networks(inputs) if full else small_networks(TRAINING[size], ("contour", "compact"))
    networks = {
        name: replace(network, train=f"{network.train} --set category=true") for name, network in chosen.items()
    }
    cups = quoted(work / "cups")
    make = Step(
        name="cups",
        why="Members of the category, and one that is kept aside.",
        command=words(f"python {quoted(ROOT / 'experiments' / 'cups.py')} {cups} --count {count} --seed 0"),
        leaves="cups/train/models_info.json",
    )
    return [
        make,
        *compared(
            work,
            trained_comparison(
                size,
                inputs,
                objects=f"--object {cups}/train",
                tested=f"--object {cups}/unseen",
                preset="category",
                networks=networks,
                smoke_pairs=120,
            ),
        ),
    ]


EXPERIMENT = Experiment(
    name=Path(__file__).stem,
    doc=__doc__,
    paper={"unseen members": "tracked, without figures"},
    minutes=TRAINED_MINUTES,
    plan=plan,
)

if __name__ == "__main__":
    main(EXPERIMENT)
