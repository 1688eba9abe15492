"""A symmetric object: the contour loss against regression of the pose, at the same budget.

The bobbin looks the same however it is turned about its axis, so the turn that took its hypothesis away cannot be read
from the pictures: regression averages over answers that look alike. The contour loss asks for the silhouette only.
Where hypotheses are drawn evenly around the truth, that average is no turn at all, which is no harm; `any-twin` draws
them around any of the poses that look like the truth, as detectors give them.
VSS, the overlap of the silhouettes of estimate and truth, is what can be right here; the paper reports it as 0.817
against 0.676 on the objects of Tejani et al., most of which are symmetric.

Test images are other scenes; initial poses are the ground truth, rotated by 0 to 20 degrees and translated by 0 to
0.2 diameters.

  --smoke  16 training steps: a test of the plumbing
  --small  preset compact with each loss, with and without any-twin, 2 000 rasterised pairs, 3 000 steps, 300 images
  --full   preset paper with each loss, 200 000 path-traced pairs, 100 000 steps, 1 000 images; a GPU

    python experiments/symmetric_loss.py --small
    python experiments/symmetric_loss.py --full --backbone-weights inception_v3_stem.safetensors
"""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
from experiments.chain import Step, quoted
from experiments.common import BOBBIN, Comparison, Experiment, Inputs, compared, full_networks, main, small_networks

TRAINING = {
    "smoke": "--steps 16 --batch 8 --set validation.pairs=16 --threads 1",
    "small": "--steps 3000 --threads 1",
}


def plan(work: Path, size: str, inputs: Inputs) -> list[Step]:
    """Commands for a size."""
    full, losses = size == "full", ("mse", "contour")
    info = BOBBIN.with_name("models_info.json")
    chosen = full_networks(inputs) if full else small_networks(TRAINING[size], losses)
    chosen = {name: chosen[name] for name in losses}
    if size == "small":
        twins = small_networks(f"{TRAINING[size]} --set hypothesis.sample_symmetries=true", losses)
        chosen |= {f"{name}-any-twin": network for name, network in twins.items()}
    return compared(
        work,
        Comparison(
            objects=f"--object {quoted(BOBBIN)} --models-info {quoted(info)}",
            scenes=f"--engine {'cycles' if full else 'raster'} {inputs.behind()}",
            pairs={"smoke": 128, "small": 2000, "full": 200_000}[size],
            frames={"smoke": 2, "small": 300, "full": 1000}[size],
            networks=chosen,
            baselines=(),
            initial="--random-up-to 20 --random-translation 0.2",
            workers=8 if full else 2,
        ),
    )


EXPERIMENT = Experiment(
    name=Path(__file__).stem,
    doc=__doc__,
    paper={"VSS": "contour loss 0.817, MSE 0.676 (Tejani et al.)"},
    minutes={
        "smoke": "a minute on two CPU cores",
        "small": "half an hour on two CPU cores",
        "full": "half a day, most of it rendering; a GPU",
    },
    plan=plan,
)

if __name__ == "__main__":
    main(EXPERIMENT)
