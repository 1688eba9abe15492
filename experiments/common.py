"""Common parts of the experiments: sizes, networks and methods to compare, and the chain from meshes to a report."""

import argparse
import json
import os
import platform
import statistics
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any

from posecore.bop import read_results
from refinenet.refine.registry import BASELINES

from experiments.chain import ROOT, Step, quoted, run_all, say, seconds_of, shown, typed, words

TUG, BOBBIN = (ROOT / "examples" / "objects" / f"{name}.ply" for name in ("tug", "bobbin"))
CHECKPOINTS = ROOT / "examples" / "checkpoints"
NEED_DEPTH = ("depth-icp",)
ON_GPUS = "--device auto"
HYPOTHESES_PER_SCENE = 8
"""Of the presets that experiments render with."""
SCORES = (
    "expected", "missing", "vss_mean", "re_sym_deg_mean", "re_sym_deg_median", "tx_mm_mean", "ty_mm_mean", "tz_mm_mean",
    "add_s_recall_0.1d",
)  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Inputs:
    """What the user has beside this repository.

    Attributes:
        data: LM-O in BOP layout: `models/`, `test/`, `test_targets_bop19.json`, and initial poses.
        backbone_weights: ImageNet weights of InceptionV3's stem; without them preset `paper` has its own stem's.
        backgrounds: Folder of photographs to put behind objects.
        hdris: Folder of panoramas to light scenes with.
    """

    data: Path | None = None
    backbone_weights: Path | None = None
    backgrounds: Path | None = None
    hdris: Path | None = None

    def models(self) -> Path:
        """Folder of LM-O's meshes.

        Raises:
            SystemExit: There is none.
        """
        models = None if self.data is None else self.data / "models"
        if models is None or not (models / "models_info.json").is_file():
            raise SystemExit(
                f"Error: no LM-O meshes: found {'no --data' if models is None else f'no {models}/models_info.json'}, "
                "expected --data FOLDER with models/, test/ and test_targets_bop19.json as BOP publishes them"
            )
        return models

    def stem(self) -> str:
        """Options of `refinenet train` for the frozen stem of preset `paper`."""
        if self.backbone_weights is None:
            return ""
        return f"--set backbone.name=inception_v3 --backbone-weights {quoted(self.backbone_weights)}"

    def behind(self) -> str:
        """Options of `synthgen` for what lies behind objects."""
        return "" if self.backgrounds is None else f"--backgrounds {quoted(self.backgrounds)}"


def lmo_meshes(inputs: Inputs) -> dict[int, str]:
    """Options of `synthgen` for each of LM-O's meshes, by object id."""
    models = inputs.models()
    info = quoted(models / "models_info.json")
    files = sorted(models.glob("obj_*.ply"))
    return {int(file.stem[4:]): f"--object {quoted(file)} --models-info {info}" for file in files}


@dataclass(frozen=True, kw_only=True)
class Network:
    """One network to train, or a checkpoint that is there.

    Attributes:
        train: Options of `refinenet train`.
        pairs: Options of `synthgen render` for its training pairs beside those of the experiment.
        pairs_divisor: Divisor of the experiment's number of pairs.
        checkpoint: Trained network; None trains one.
    """

    train: str = ""
    pairs: str = ""
    pairs_divisor: int = 1
    checkpoint: Path | None = None


SHIPPED = {
    "shipped": Network(checkpoint=CHECKPOINTS / "tug_compact.safetensors"),
    "shipped-flow": Network(checkpoint=CHECKPOINTS / "tug_flow.safetensors"),
}
"""Networks of the example object that need no training: presets `compact` and `flow`."""


def small_networks(options: str, names: tuple[str, ...]) -> dict[str, Network]:
    """Preset `compact` with each loss; the name `compact` is the preset as it is, with its contour and point loss."""
    pairs = "--set patch_px=128 --set window.padding=0.6 --set hypotheses_per_scene=1"
    losses = {name: "" if name == "compact" else f" --loss {name}" for name in names}
    return {name: Network(train=f"--preset compact{loss} {options}", pairs=pairs) for name, loss in losses.items()}


def full_networks(inputs: Inputs) -> dict[str, Network]:
    """Preset `paper` with each loss, 100 000 steps of 16 pairs, and preset `plus`.

    `plus` cuts its own window out of wider patches and draws its own hypotheses: it gets as many scenes, each once.
    """
    losses = ("mse", "contour-forward", "contour")
    networks = {loss: Network(train=f"--preset paper --loss {loss} {inputs.stem()}") for loss in losses}
    wide = "--set window.padding=0.6 --set hypotheses_per_scene=1"
    return networks | {"plus": Network(train="--preset plus", pairs=wide, pairs_divisor=HYPOTHESES_PER_SCENE)}


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """Refinement methods side by side, from the same initial poses.

    Attributes:
        objects: Options of `synthgen` that name the meshes.
        each: Meshes with a network of their own by object id; empty where one network serves all objects.
        scenes: Options of `synthgen` for both training pairs and test images.
        pairs: Training pairs of one network, where one is trained.
        frames: Rendered test images.
        networks: By the name in the report.
        baselines: Methods without a network.
        initial: Options of `evalkit perturb`.
        iterations: Of `refinenet refine`, the same for all methods.
        dataset: Real test images, instead of rendered ones.
        init: Initial poses for them, instead of perturbed ones.
        workers: Processes that render test images.
        render: Options of `synthgen render` that say where it runs.
        tested: Options of `synthgen` that name the meshes in test images, where those are others.
    """

    objects: str
    each: Mapping[int, str] = field(default_factory=dict)
    scenes: str
    pairs: int = 0
    frames: int = 0
    networks: Mapping[str, Network]
    baselines: tuple[str, ...] = tuple(BASELINES)
    initial: str = ""
    iterations: int = 5
    dataset: Path | None = None
    init: Path | None = None
    workers: int = 2
    render: str = "--workers 2"
    tested: str | None = None


def lmo_comparison(inputs: Inputs, frames: int, initial: str, iterations: int = 5) -> Comparison:
    """Size `full` on LM-O's meshes: networks of the paper for each object, 200 000 path-traced pairs each."""
    return Comparison(
        objects=f"--object {quoted(inputs.models())}",
        each=lmo_meshes(inputs),
        scenes=f"--preset linemod --engine cycles {inputs.behind()}",
        pairs=200_000,
        frames=frames,
        networks=full_networks(inputs),
        initial=initial,
        iterations=iterations,
        workers=8,
        render=ON_GPUS,
    )


def trained_comparison(
    size: str,
    inputs: Inputs,
    *,
    objects: str,
    preset: str,
    networks: Mapping[str, Network],
    smoke_pairs: int,
    tested: str | None = None,
) -> Comparison:
    """Networks trained at every size, path-traced at size `full`; up to 20 degrees and 0.2 diameters of error."""
    full = size == "full"
    return Comparison(
        objects=objects,
        tested=tested,
        scenes=f"--preset {preset} --engine {'cycles' if full else 'raster'} {inputs.behind()}",
        pairs={"smoke": smoke_pairs, "small": 3000, "full": 200_000}[size],
        frames={"smoke": 2, "small": 60, "full": 1000}[size],
        networks=networks,
        initial="--random-up-to 20 --random-translation 0.2",
        workers=8 if full else 2,
        render=ON_GPUS if full else "--workers 2",
    )


TRAINED_MINUTES = {
    "smoke": "two minutes on two CPU cores",
    "small": "a quarter of an hour on two CPU cores",
    "full": "a day, most of it rendering; a GPU",
}
"""Duration of a `trained_comparison` by size."""


def compared(work: Path, what: Comparison) -> list[Step]:
    """The chain of a comparison: pairs, networks, test images, initial poses, every method's poses, tables, report."""
    folder = quoted(work)
    dataset = f"{folder}/test_bop" if what.dataset is None else quoted(what.dataset)
    init = f"{folder}/results/initial.csv" if what.init is None else quoted(what.init)
    steps = [*trainings(work, what)]
    if what.dataset is None:
        steps.append(
            rendered_frames(work, what.tested or what.objects, f"{what.scenes} --workers {what.workers}", what.frames)
        )
    if what.init is None:
        steps.append(initial_poses(work, what.initial))
    refine = f"refinenet refine --dataset {dataset} --init {init} --iterations {what.iterations} --keep-failed"
    results = []
    for name, network in what.networks.items():
        steps += refinements(work, what, refine, name, network)
        results.append(name)
    for name in what.baselines:
        steps.append(refinement(work, f"{refine} --method {name}", name, f"The same initial poses, refined by {name}."))
        results.append(name)
    named = " ".join(f"--results {path}" for path in [init, *(f"{folder}/results/{name}.csv" for name in results)])
    steps.append(
        Step(
            name="tables",
            why="The paper's tables of them.",
            command=words(
                f"evalkit tables --dataset {dataset} {named} --out {folder}/tables.md --out {folder}/tables.json"
            ),
            leaves="tables.json",
        )
    )
    steps.append(report(work, f"--dataset {dataset} {named}"))
    return steps


def trainings(work: Path, what: Comparison) -> Iterator[Step]:
    """Render training pairs and train the networks; networks with the same options use the same pairs."""
    folder = quoted(work)
    trained = {name: network for name, network in what.networks.items() if network.checkpoint is None}
    kinds = list(dict.fromkeys((network.pairs, network.pairs_divisor) for network in trained.values()))
    shards = {kind: f"shards{number or ''}" for number, kind in enumerate(kinds)}
    groups = {f"_{number:06d}": (f", object {number}", mesh) for number, mesh in what.each.items()}
    for group, (which, objects) in (groups or {"": ("", what.objects)}).items():
        for (options, divisor), name in shards.items():
            render = f"synthgen render {objects} {what.scenes} {options} --n {what.pairs // divisor} --seed 1"
            render += " --test-images 0"
            yield Step(
                name=f"{name}{group}",
                why=f"Training pairs{which}, from meshes alone.",
                command=words(f"{render} {what.render} --out {folder}/{name}{group}"),
                leaves=f"{name}{group}/manifest.jsonl",
            )
        for name, network in trained.items():
            source = shards[network.pairs, network.pairs_divisor]
            train = f"refinenet train {folder}/{source}{group} {network.train} --seed 0"
            yield Step(
                name=f"train-{name}{group}",
                why=f"Network '{name}'{which}.",
                command=words(f"{train} --out {folder}/run_{name}{group}"),
                leaves=f"run_{name}{group}/best.safetensors",
                run=f"run_{name}{group}",
            )


def rendered_frames(work: Path, objects: str, options: str, frames: int, out: str = "test_bop") -> Step:
    """Test images with ground truth: scenes of another seed than the training pairs'."""
    return Step(
        name=out,
        why="Test images with ground truth: other scenes.",
        command=words(f"synthgen bop {objects} {options} --frames {frames} --seed 102 --out {quoted(work)}/{out}"),
        leaves=f"{out}/models/models_info.json",
    )


def initial_poses(work: Path, options: str, dataset: str = "test_bop", name: str = "initial") -> Step:
    """Initial poses: ground truth, perturbed."""
    folder = quoted(work)
    return Step(
        name=f"{name}-poses",
        why="Initial poses: ground truth, perturbed.",
        command=words(
            f"evalkit perturb --dataset {folder}/{dataset} {options} --seed 103 --out {folder}/results/{name}.csv"
        ),
        leaves=f"results/{name}.csv",
    )


def refinements(work: Path, what: Comparison, refine: str, name: str, network: Network) -> Iterator[Step]:
    """Refine with a network; where each object has its own, one after another and then joined."""
    folder, why = quoted(work), f"Refined by network '{name}'."
    if network.checkpoint is not None:
        yield refinement(work, f"{refine} --checkpoint {quoted(network.checkpoint)}", name, why)
    elif not what.each:
        yield refinement(work, f"{refine} --checkpoint {folder}/run_{name}/best.safetensors", name, why)
    else:
        parts = [f"{name}_{number:06d}" for number in what.each]
        for number, part in zip(what.each, parts, strict=True):
            chosen = f"--object {number} --checkpoint {folder}/run_{part}/best.safetensors"
            yield refinement(work, f"{refine} {chosen}", part, f"Object {number}, refined by its network.", "parts")
        yield joined(work, name, parts)


def joined(work: Path, name: str, parts: Sequence[str]) -> Step:
    """One result file of a method's parts."""
    folder = quoted(work)
    files = " ".join(f"{folder}/parts/{part}.csv" for part in parts)
    return Step(
        name=f"join-{name}",
        why=f"All of '{name}' in one result file.",
        command=words(f"python {quoted(ROOT / 'experiments' / 'join.py')} {files} --out {folder}/results/{name}.csv"),
        leaves=f"results/{name}.csv",
    )


def refinement(work: Path, refine: str, name: str, why: str, place: str = "results") -> Step:
    """One result file."""
    return Step(
        name=f"refine-{name}",
        why=why,
        command=words(f"{refine} --name {name} --out {quoted(work)}/{place}/{name}.csv"),
        leaves=f"{place}/{name}.csv",
    )


def report(work: Path, options: str, name: str = "report") -> Step:
    """The evaluation, on one page."""
    return Step(
        name=name,
        why="What came of it, on one page.",
        command=words(f"evalkit report {options} --out {quoted(work)}/{name}"),
        leaves=f"{name}/summary.json",
    )


@dataclass(frozen=True, kw_only=True)
class Experiment:
    """One row of the paper's experiments.

    Attributes:
        name: The file's name.
        doc: The file's docstring.
        paper: The paper's figures, by what they are of.
        minutes: By size, what to expect.
        plan: From working folder, size and inputs to the commands.
        measured: What the result holds beside the report's scores, read from the working folder.
    """

    name: str
    doc: str
    paper: Mapping[str, str]
    minutes: Mapping[str, str]
    plan: Callable[[Path, str, Inputs], list[Step]]
    measured: Callable[[Path], dict[str, Any]] = lambda _work: {}


def run(experiment: Experiment) -> int:
    """Run an experiment from the command line.

    Returns:
        Exit code.
    """
    parser = argparse.ArgumentParser(
        prog=f"{experiment.name}.py", description=experiment.doc, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("work", nargs="?", type=Path, default=None, help="working folder (experiment-NAME-SIZE)")
    sizes = parser.add_mutually_exclusive_group()
    for size, minutes in experiment.minutes.items():
        sizes.add_argument(f"--{size}", dest="size", action="store_const", const=size, help=minutes)
    parser.set_defaults(size="small")
    parser.add_argument("--data", type=Path, help="LM-O in BOP layout: models/, test/, test_targets_bop19.json")
    parser.add_argument("--backbone-weights", type=Path, help="ImageNet weights of InceptionV3's stem (safetensors)")
    parser.add_argument("--backgrounds", type=Path, help="photographs to put behind objects")
    parser.add_argument("--hdris", type=Path, help="panoramas to light scenes with, where an experiment does")
    parser.add_argument("--list", action="store_true", help="show the commands and run none")
    chosen = parser.parse_args()
    work = (chosen.work or Path(f"experiment-{experiment.name}-{chosen.size}")).resolve()
    if work.exists() and not work.is_dir():
        raise SystemExit(f"Error: {work}: is a file, expected a folder to work in; name another")
    given = {name: getattr(chosen, name) for name in ("data", "backbone_weights", "backgrounds", "hdris")}
    for name, path in given.items():
        if path is not None and not path.exists():
            raise SystemExit(f"Error: --{name.replace('_', '-')} {path}: there is no such file or folder")
    inputs = Inputs(**{name: None if path is None else path.resolve() for name, path in given.items()})
    steps = experiment.plan(work, chosen.size, inputs)
    if chosen.list:
        for step in steps:
            say(typed(step, work, step.command))
        return 0
    say(f"Working in {shown(work)}; {experiment.minutes[chosen.size]}. Stop with Ctrl-C, start again to go on.")
    try:
        run_all(work, steps)
    except KeyboardInterrupt:
        raise SystemExit("\nStopped. The same command goes on from here.") from None
    say(f"\nReport: {work / 'report' / 'index.html'}")
    say(f"Result: {write_result(experiment, work, chosen.size, inputs, steps)}")
    return 0


def write_result(experiment: Experiment, work: Path, size: str, inputs: Inputs, steps: list[Step]) -> Path:
    """Write what was run and what came of it as `result.json` in the working folder."""
    took_s = seconds_of(work, steps)
    result = {
        "experiment": experiment.name,
        "size": size,
        "finished_utc": datetime.now(UTC).isoformat(timespec="seconds"),
        "machine": {"platform": platform.platform(), "cpus": os.cpu_count(), "python": platform.python_version()},
        "versions": {name: metadata.version(name) for name in ("posecore", "synthgen", "refinenet", "evalkit")},
        "inputs": {name: None if path is None else path.name for name, path in asdict(inputs).items()},
        "steps": [
            {"name": step.name, "command": typed(step, work, step.command), "seconds": took_s.get(step.name)}
            for step in steps
        ],
        "training_seconds": {step.name: took_s.get(step.name) for step in steps if step.run is not None},
        "paper": dict(experiment.paper),
        "methods": reported(work / "report" / "summary.json"),
        **experiment.measured(work),
    }
    path = work / "result.json"
    path.write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")
    return path


def reported(summary: Path) -> dict[str, dict[str, Any]]:
    """The scores of every result file of a report, by its name."""
    files = json.loads(summary.read_text(encoding="utf-8"))["files"]
    return {file["name"]: {key: file["total"][key] for key in SCORES} for file in files}


def median_ms(results: Path) -> float:
    """Median time of one image's poses in a result file, milliseconds."""
    taken_s = {(line.scene_id, line.im_id): line.time_s for line in read_results(results)}
    return round(1e3 * statistics.median(taken_s.values()), 2)


def main(experiment: Experiment) -> None:
    """Run an experiment as a script does."""
    sys.exit(run(experiment))
