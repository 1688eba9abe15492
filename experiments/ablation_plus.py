"""What is each idea of preset `plus` worth? All of them, and all but one, at the same budget.

Every network sees the same pairs in the same order for the same number of steps; one switch differs:

  crop-window      windows of fixed side instead of ones that follow distance and diameter
  6d-rotation      quaternion instead of 6D
  crop-translation metres in camera axes instead of image-plane shift and depth ratio
  point-loss       contour loss alone
  contour-loss     point loss alone
  in-plane         scenes are not rotated about the optical axis
  online           the hypotheses that were rendered with the pairs
  on-policy        drawn hypotheses only
  confidence       no confidence output
  background, occlusion, colour   that augmentation is off
  ema              the weights themselves instead of their moving average

`--small` has `paper-choices` beside them: every switch off at once, as in the paper, with the same network. Its
pairs are rendered as that network takes them, with the renderer's own hypotheses.

Test images are other scenes; initial poses are the ground truth, rotated by 0 to 20 degrees and translated by 0 to
0.2 diameters.

  --smoke  two networks, 16 training steps: a test of the plumbing
  --small  preset compact with every switch of plus on, the tug, 2 000 rasterised pairs, 3 000 steps of 32, 300 images
  --full   presets plus and paper, the tug, 200 000 rasterised pairs, 100 000 steps, 1 000 images; a GPU

    python experiments/ablation_plus.py --small
    python experiments/ablation_plus.py --full --backbone-weights inception_v3_stem.safetensors

A short run favours what helps early: read `--small` as a first hint.
"""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
from experiments.chain import Step, quoted
from experiments.common import TUG, Comparison, Experiment, Inputs, Network, compared, main

OFF = {
    "crop-window": "window.kind=fixed",
    "6d-rotation": "network.rotation=quaternion",
    "crop-translation": "network.translation=camera",
    "point-loss": "loss.name=contour",
    "contour-loss": "loss.name=point",
    "in-plane": "hypothesis.in_plane=false",
    "online": "hypothesis.online=false",
    "on-policy": "on_policy.fraction=0",
    "confidence": "network.confidence=false",
    "background": "augment.background=0",
    "occlusion": "augment.occlusion=0",
    "colour": (
        "augment.permute_channels=0 augment.gain=0 augment.scene_gain=0 augment.brightness=0 augment.contrast=0"
        " augment.noise=0 augment.blur=0"
    ),
    "ema": "optimiser.ema_decay=0",
}
"""Settings that turn each switch off."""

ON = "network.confidence=true on_policy.fraction=0.5 on_policy.updates=2 augment.occlusion=0.3 optimiser.ema_decay=0.99"
"""Settings that turn on in `compact` what it leaves off."""

BUDGET = {
    "smoke": "--steps 16 --batch 8 --set validation.pairs=16 --threads 1",
    "small": "--steps 3000 --threads 1 --set validation.every=1000",
    "full": "",
}


def settings(text: str) -> str:
    """Options of `refinenet train` for settings."""
    return " ".join(f"--set {item}" for item in text.split())


def networks(size: str, inputs: Inputs) -> dict[str, Network]:
    """All switches on, each off, and on a GPU the paper's design beside them."""
    base = f"--preset plus {BUDGET[size]}" if size == "full" else f"--preset compact {settings(ON)} {BUDGET[size]}"
    pairs = f"--set patch_px={256 if size == 'full' else 128} --set window.padding=0.6 --set hypotheses_per_scene=1"
    off = {"on-policy": OFF["on-policy"]} if size == "smoke" else OFF
    made = {"all": Network(train=base, pairs=pairs)}
    made |= {f"without-{name}": Network(train=f"{base} {settings(text)}", pairs=pairs) for name, text in off.items()}
    if size == "small":
        choices = " ".join(text for name, text in OFF.items() if name != "contour-loss")
        # Fixed windows and stored hypotheses: the patches are taken as they are rendered.
        as_they_are = "--set patch_px=64 --set hypotheses_per_scene=1"
        made["paper-choices"] = Network(train=f"{base} {settings(choices)}", pairs=as_they_are)
    if size == "full":
        made["paper"] = Network(train=f"--preset paper {inputs.stem()}", pairs="--set hypotheses_per_scene=1")
    return made


def plan(work: Path, size: str, inputs: Inputs) -> list[Step]:
    """Commands for a size."""
    return compared(
        work,
        Comparison(
            objects=f"--object {quoted(TUG)}",
            scenes=f"--engine raster {inputs.behind()}",
            pairs={"smoke": 128, "small": 2000, "full": 200_000}[size],
            frames={"smoke": 2, "small": 300, "full": 1000}[size],
            networks=networks(size, inputs),
            baselines=(),
            initial="--random-up-to 20 --random-translation 0.2",
            workers=8 if size == "full" else 2,
        ),
    )


EXPERIMENT = Experiment(
    name=Path(__file__).stem,
    doc=__doc__,
    paper={"ablation of these switches": "none; method.md, preset plus, has the evidence they were chosen by"},
    minutes={
        "smoke": "two minutes on two CPU cores",
        "small": "an hour and a quarter on two CPU cores",
        "full": "a day; a GPU",
    },
    plan=plan,
)

if __name__ == "__main__":
    main(EXPERIMENT)
