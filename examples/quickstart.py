"""From a mesh to a report: render pairs, train a small network, refine poses it has never seen, compare.

    python examples/quickstart.py quickstart

The three commands of the README in a folder of their own, with the settings of a small run on two CPU cores, and a
network that ships beside the one just trained. Each is shown as you would type it. A step that is complete is not done
again, so the script can be stopped and started at will. At the end it checks that the network just trained earned its
keep.
"""

import argparse
import json
import os
import shlex
import sys
import webbrowser
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
from experiments.chain import ROOT, Step, run_all, say, shown, words

OBJECT = ROOT / "examples" / "objects" / "tug.ply"
SHIPPED = ROOT / "examples" / "checkpoints" / "tug_compact.safetensors"


@dataclass(frozen=True, kw_only=True)
class Size:
    """How much of everything.

    Attributes:
        pairs: Training pairs.
        frames: Test images.
        engine: Renderer of both.
        train: Further options of `refinenet train`.
        minutes: What to expect on two CPU cores, for the user.
    """

    pairs: int
    frames: int
    engine: str
    train: str = ""
    minutes: str


FULL = Size(pairs=6000, frames=150, engine="cycles", train="--steps 6000 --threads 1", minutes="about 16 minutes")
SMOKE = Size(
    pairs=64,
    frames=3,
    engine="raster",
    train="--steps 6 --batch 8 --set validation.pairs=8",
    minutes="about a minute",
)


@dataclass(frozen=True, kw_only=True)
class Promise:
    """One line of what the quick start promises, as found in the report."""

    text: str
    kept: bool


def steps(size: Size) -> Iterator[Step]:
    """Yield the commands of the quick start in order; all run in the working folder."""
    yield Step(
        name="render",
        why="Training pairs of the object from its mesh alone, and test images of other scenes.",
        command=words(
            f"synthgen render --object {shlex.quote(str(OBJECT))} --preset quickstart --engine {size.engine} --seed 1"
            f" --n {size.pairs} --test-images {size.frames} --workers 2"
        ),
        leaves="shards/manifest.jsonl",
        inside=True,
    )
    yield Step(
        name="train",
        why="A small refinement network; at the end it refines start poses in the test images.",
        command=words(f"refinenet train shards/ {size.train}"),
        leaves="results/compact.csv",
        removes=("results/initial.csv", "results/compact.csv"),
        run="runs/compact",
        inside=True,
    )
    if SHIPPED.is_file():
        yield Step(
            name="refine-shipped",
            why="The same start poses, refined by a network that trained for longer.",
            command=words(
                f"refinenet refine --dataset shards/test_bop --init results/initial.csv --checkpoint "
                f"{shlex.quote(str(SHIPPED))} --out results/shipped.csv"
            ),
            leaves="results/shipped.csv",
            inside=True,
        )
    yield Step(
        name="report",
        why="Start poses and refined poses, on one page.",
        command=words("evalkit report"),
        leaves="report/summary.json",
        inside=True,
    )


def promises(summary: dict[str, Any]) -> list[Promise]:
    """Compare the poses of the network just trained with the start poses, by the report's numbers."""
    quick = next(entry for entry in summary["against_initial"] if entry["name"] == "compact")
    vss, medians = quick["vss_mean"], quick["medians"]
    gain = vss["refined"] - vss["reference"]
    bounds = [("median error in x", "tx_mm", 0.5), ("median error in y", "ty_mm", 0.5)]
    bounds += [("median rotation error", "re_sym_deg", 0.8)]
    # A start without error has no ratio; that keeps no promise.
    shares = [(name, medians[key]["ratio"] or float("nan"), most) for name, key, most in bounds]
    none_lost = Promise(text=f"poses without a result: {quick['missing']} (promised none)", kept=quick["missing"] == 0)
    return [
        Promise(text=f"mean VSS up by {gain:.3f} (promised 0.08)", kept=gain >= 0.08),
        *(
            Promise(text=f"{name}: {x:.2f} of the start's (promised {most})", kept=x <= most)
            for name, x, most in shares
        ),
        none_lost,
    ]


def show(page: Path) -> None:
    """Say where the report is, and open it where there is a display."""
    say(f"\nReport: {page.resolve()}")
    if sys.platform == "darwin" or os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"):
        webbrowser.open(page.resolve().as_uri())


def main() -> int:
    """Run the quick start; return 1 where the promised improvement is missing."""
    parser = argparse.ArgumentParser(description="From a mesh to a report, in one go.")
    parser.add_argument("work", nargs="?", type=Path, default=Path("quickstart"), help="working folder (%(default)s)")
    parser.add_argument("--smoke", action="store_true", help="tiny, rasterised, and no promise: a test of the plumbing")
    arguments = parser.parse_args()
    work, size = arguments.work.resolve(), SMOKE if arguments.smoke else FULL
    say(f"Working in {shown(work)}; {size.minutes} on two CPU cores. Stop with Ctrl-C, start again to go on.")
    try:
        run_all(work, list(steps(size)))
    except KeyboardInterrupt:
        raise SystemExit("\nStopped. The same command goes on from here.") from None
    kept = True
    if not arguments.smoke:
        say("\nWhat the network just trained did to poses on images it has never seen:")
        summary = json.loads((work / "report" / "summary.json").read_text(encoding="utf-8"))
        for promise in promises(summary):
            say(f"  {'ok    ' if promise.kept else 'MISSED'} {promise.text}")
            kept = kept and promise.kept
    show(work / "report" / "index.html")
    return 0 if kept else 1


if __name__ == "__main__":
    sys.exit(main())
