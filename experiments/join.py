"""Join result files of the same method on the same dataset, as of networks that each serve one object.

python experiments/join.py parts/contour_000001.csv parts/contour_000005.csv --out results/contour.csv
"""

import argparse
import sys
from pathlib import Path

from posecore.bop import read_results, read_sidecar, write_results


def parser() -> argparse.ArgumentParser:
    """The command line."""
    made = argparse.ArgumentParser(description="Join result files of one method on one dataset.")
    made.add_argument("parts", nargs="+", type=Path, help="result files")
    made.add_argument("--out", required=True, type=Path, help="result file to write")
    return made


SAME = ("dataset", "split", "init", "perturbation", "settings")
LISTS = ("initial_lines", "failed_lines", "resets", "misses")


def join(parts: list[Path], out: Path) -> None:
    """Write all lines of the parts in their order; the sidecar has what they have in common, and their lists joined."""
    sidecars = [read_sidecar(part) or {} for part in parts]
    sidecar = {key: sidecars[0][key] for key in SAME if key in sidecars[0]}
    sidecar |= {key: [item for one in sidecars for item in one[key]] for key in LISTS if key in sidecars[0]}
    sidecar |= {
        "method": out.stem,
        "parts": {part.name: one.get("checkpoint_sha256") for part, one in zip(parts, sidecars, strict=True)},
    }
    write_results(out, [line for part in parts for line in read_results(part)], sidecar)


def main() -> int:
    """Run from the command line."""
    chosen = parser().parse_args()
    join(chosen.parts, chosen.out)
    return 0


if __name__ == "__main__":
    sys.exit(main())
