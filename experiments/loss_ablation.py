"""Which loss? The contour loss against regression of the pose, all else equal.

Protocol (section 4.3 of the paper, on the dataset of Tejani et al.): the same network trained with either
loss, VSS after refinement. The paper: 0.817 with the contour loss, 0.676 with MSE; a tracker on RGB-D reaches 0.627, a
region-based one 0.304.

Here the objects are the two that ship: the tug, without a symmetry, and the bobbin, which looks the same however it is
turned about its axis, so that its rotation cannot be regressed. One network serves both. Test images are other scenes,
initial poses are the ground truth, rotated by 0 to 20 degrees and translated by 0 to 0.2
diameters.

  --smoke  16 training steps: a test of the plumbing
  --small  preset compact with each loss, 3 000 rasterised pairs, 1 500 steps, 60 images
  --full   preset paper with each loss, 200 000 path-traced pairs, 100 000 steps, 1 000 images; a GPU

    python experiments/loss_ablation.py --small
    python experiments/loss_ablation.py --full --backbone-weights inception_v3_stem.safetensors
"""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
from experiments.chain import Step, quoted
from experiments.common import (
    BOBBIN,
    TRAINED_MINUTES,
    TUG,
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
    full, losses = size == "full", ("mse", "contour-forward", "contour", "compact")
    info = TUG.with_name("models_info.json")
    return compared(
        work,
        trained_comparison(
            size,
            inputs,
            objects=f"--object {quoted(TUG)} --object {quoted(BOBBIN)} --models-info {quoted(info)}",
            preset="tejani",
            networks=full_networks(inputs) if full else small_networks(TRAINING[size], losses),
            smoke_pairs=128,
        ),
    )


EXPERIMENT = Experiment(
    name=Path(__file__).stem,
    doc=__doc__,
    paper={"VSS": "contour loss 0.817, MSE 0.676 (RGB-D tracker 0.627, region tracker 0.304)"},
    minutes=TRAINED_MINUTES,
    plan=plan,
)

if __name__ == "__main__":
    main(EXPERIMENT)
