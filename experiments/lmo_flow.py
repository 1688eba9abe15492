"""Real images with heavy occlusion, as in `lmo_add.py`: `search` with a network of preset `flow`.

The network learns twice: from rendered pairs, and then from what `search` weighs with it, in frames that stand in for
real ones (`stand_ins.py`): it is as good as its judge, and those are what a judge has to tell apart. LM-O's
real frames are for testing only; their initial poses are the result file `init*.csv` in --data.

  --smoke  a few steps on a few pairs, one object: a test of the plumbing
  --small  9 600 path-traced pairs, 210 frames
  --full   100 000 pairs, 3 000 frames; a GPU

    python experiments/lmo_flow.py --small --data lmo --backgrounds backgrounds --hdris hdri
"""

import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
from experiments.chain import ROOT, Step, quoted, words
from experiments.common import ON_GPUS, Experiment, Inputs, main, refinement, report
from experiments.lmo_add import EXPERIMENT as PROTOCOL
from experiments.lmo_add import initial_poses_file

SETS = (17, 18, 19)
"""Seeds of the sets of frames, each of other altered meshes."""
PATCHES = "--set patch_px=160"
FRAMES = (
    "--objects-per-frame 6 8 --preset tabletop --set distance.min=5 --set background.photo_fraction=0.85 "
    "--set tabletop.near_fraction=0.5 --set tabletop.hover_diameter=[0,0.05] --set tabletop.gap_diameter=[0,0.05] "
    "--set tabletop.size_diameter=[6,10] --set tabletop.distractors=[2,5] --set tabletop.elevation_deg=[12,50]"
)
"""Crowded, so that half of the objects are hidden in part."""
INITIAL_POSES = "--random-up-to 65 --random-translation 0.3 --depth-stretch 6"
LOADER = "--threads 1 --set loader.cache_mb=6000 --set validation.scene_fraction=0.04"
MISTAKES = "--set hypothesis.precomputed_fraction=0.5 --set loss.min_pose_quality=0.02 --set loader.shuffle_shards=32"


@dataclass(frozen=True, kw_only=True)
class Size:
    """How much of everything.

    Attributes:
        pairs: Rendered pairs.
        frames: Of each set.
        learn: Options of the first training.
        judge: Options of the second.
        render: Options of `synthgen render` that say with what.
        frame: The same of `synthgen bop`.
        refine: Options of `refinenet refine` that say with what.
        tested: The same, which poses.
        smaller: Options of `synthgen` for small scenes.
    """

    pairs: int
    frames: int
    learn: str
    judge: str
    render: str
    frame: str
    refine: str
    tested: str = ""
    smaller: str = ""


SIZES = {
    "smoke": Size(
        pairs=64,
        frames=2,
        learn="--steps 4 --batch 8 --set validation.pairs=16",
        judge="--steps 4 --batch 8 --set validation.pairs=16",
        render="--engine raster --workers 2",
        frame="--engine raster --workers 1",
        refine="--workers 2 --threads 1",
        tested="--object 1",
        smaller="--set shard_size=8",
    ),
    "small": Size(
        pairs=9600,
        frames=70,
        learn="--steps 4200 --set loader.shuffle_shards=8",
        judge="--steps 3600 --set optimiser.lr=0.0005",
        render="--engine cycles --samples 6 --workers 2",
        frame="--engine cycles --samples 12 --workers 2",
        refine="--workers 2 --threads 1",
    ),
    "full": Size(
        pairs=100_000,
        frames=1000,
        learn="--steps 100000",
        judge="--steps 50000 --set optimiser.lr=0.0005",
        render=f"--engine cycles --samples 6 {ON_GPUS}",
        frame="--engine cycles --samples 12 --workers 8",
        refine="--workers 8 --threads 1",
    ),
}


def plan(work: Path, size: str, inputs: Inputs) -> list[Step]:
    """Commands for a size."""
    models, chosen, folder = inputs.models(), SIZES[size], quoted(work)
    assert inputs.data is not None
    data, init = quoted(inputs.data), quoted(initial_poses_file(inputs.data))
    lights = "" if inputs.hdris is None else f"--hdris {quoted(inputs.hdris)}"
    named = quoted(models)
    steps = [
        Step(
            name="pairs",
            why="Training pairs, from meshes alone.",
            command=words(
                f"synthgen render --object {named} --n {chosen.pairs} --test-images 0 --seed 1 --preset linemod "
                f"{chosen.render} "
                f"{inputs.behind()} {lights} --occluders {named} {PATCHES} --set window.padding=0.35 "
                f"--set hypotheses_per_scene=1 --set occluders.visible_fraction=[0.5,1.0] {chosen.smaller} "
                f"--out {folder}/pairs"
            ),
            leaves="pairs/manifest.jsonl",
        ),
        training("learn", "A network that refines and judges.", work, "pairs", f"{LOADER} {chosen.learn}"),
    ]
    behind = inputs.behind()
    if inputs.backgrounds is not None:
        behind = f"--backgrounds {folder}/behind"
        steps.append(
            Step(
                name="boards",
                why="Backgrounds with boards of markers among them.",
                command=script(f"boards {quoted(inputs.backgrounds)} --out {folder}/behind"),
                leaves="behind/board0.png",
            )
        )
    for seed in SETS:
        steps += mistakes(work, models, chosen, seed, f"{behind} {lights}")
    parts = " ".join(f"{folder}/mistakes{seed}" for seed in SETS)
    steps += [
        Step(
            name="merge",
            why="Rendered pairs and mistakes in one dataset.",
            command=words(f"synthgen merge {folder}/pairs {parts} --out {folder}/all"),
            leaves="all/manifest.jsonl",
        ),
        training(
            "judge", "The same network, and what it took for right.", work, "all",
            f"--init {folder}/run_learn/best.safetensors {LOADER} {MISTAKES} {chosen.judge}",
        ),
    ]  # fmt: skip
    refine = f"refinenet refine --dataset {data} --init {init} --keep-failed {chosen.refine} {chosen.tested}"
    # the judge's best is not the checkpoint whose poses are best from hypotheses that are drawn
    networks = {"learn": "run_learn/best.safetensors", "judge": "run_judge/last.safetensors"}
    methods = {"search": "", **{name: f"--checkpoint {folder}/{file}" for name, file in networks.items()}}
    for name, network in methods.items():
        why = f"Real frames: `search`{' with network ' + repr(name) if network else ''}."
        steps.append(refinement(work, f"{refine} --method search {network}", name, why))
    results = " ".join(f"--results {path}" for path in (init, *(f"{folder}/results/{name}.csv" for name in methods)))
    steps.append(
        Step(
            name="tables",
            why="The paper's tables of them.",
            command=words(
                f"evalkit tables --dataset {data} {results} --out {folder}/tables.md --out {folder}/tables.json"
            ),
            leaves="tables.json",
        )
    )
    steps.append(report(work, f"--dataset {data} {results}"))
    return steps


def training(name: str, why: str, work: Path, pairs: str, options: str) -> Step:
    """One training of preset `flow`."""
    folder = quoted(work)
    return Step(
        name=name,
        why=why,
        command=words(f"refinenet train {folder}/{pairs} --preset flow --seed 0 {options} --out {folder}/run_{name}"),
        leaves=f"run_{name}/best.safetensors",
        run=f"run_{name}",
    )


def script(arguments: str) -> tuple[str, ...]:
    """A call of `stand_ins.py`."""
    return words(f"python {quoted(ROOT / 'experiments' / 'stand_ins.py')} {arguments}")


def mistakes(work: Path, models: Path, size: Size, seed: int, scenes: str) -> Iterator[Step]:
    """Frames of altered meshes, initial poses in them, what `search` weighs from those, and the pairs cut out there."""
    folder, named = quoted(work), quoted(models)
    frames, altered, start = (f"{folder}/{name}{seed}" for name in ("frames", "altered", "start"))
    yield Step(
        name=f"altered{seed}",
        why=f"Meshes that differ from the known ones, set {seed}.",
        command=script(f"meshes {named} --seed {seed} --out {altered}"),
        leaves=f"altered{seed}/models_info.json",
    )
    yield Step(
        name=f"frames{seed}",
        why="Frames of them.",
        command=words(
            f"synthgen bop --object {altered} --occluders {altered} {FRAMES} {size.frame} {scenes} "
            f"--frames {size.frames} --seed 3{seed} --out {frames}"
        ),
        leaves=f"frames{seed}/test_targets_bop19.json",
    )
    yield Step(
        name=f"known{seed}",
        why="The known meshes as their models.",
        command=script(f"known {frames} {named}"),
        leaves=f"frames{seed}/models/models_info.json",
    )
    yield Step(
        name=f"start{seed}",
        why="Initial poses that err most in depth.",
        command=words(f"evalkit perturb --dataset {frames} {INITIAL_POSES} --seed {seed} --out {start}.csv"),
        leaves=f"start{seed}.csv",
    )
    yield Step(
        name=f"weighed{seed}",
        why="What `search` weighs from there.",
        command=words(
            f"refinenet refine --method search --checkpoint {folder}/run_learn/best.safetensors --dataset {frames} "
            f"--init {start}.csv --keep-failed {size.refine} --out {folder}/found{seed}.csv "
            f"--candidates {folder}/weighed{seed}.csv"
        ),
        leaves=f"weighed{seed}.csv",
    )
    yield Step(
        name=f"mistakes{seed}",
        why="Those, cut out of the frames.",
        command=words(
            f"synthgen cut --dataset {frames} --hypotheses {folder}/weighed{seed}.csv {PATCHES} --set scale=2.2 "
            f"{size.smaller} --workers 2 "
            f"--out {folder}/mistakes{seed}"
        ),
        leaves=f"mistakes{seed}/manifest.jsonl",
    )


EXPERIMENT = Experiment(
    name=Path(__file__).stem,
    doc=__doc__,
    paper=PROTOCOL.paper,
    minutes={
        "smoke": "about ten minutes on two CPU cores",
        "small": "about two and a half hours on two CPU cores",
        "full": "days, most of them rendering; a GPU",
    },
    plan=plan,
)

if __name__ == "__main__":
    main(EXPERIMENT)
