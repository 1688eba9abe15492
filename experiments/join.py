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


def join(parts: list[Path], out: Path) -> None:
    """Write all lines of the parts in their order, with the sidecar's common facts and the parts' own beside them."""
    sidecars = [read_sidecar(part) or {} for part in parts]
    common = {key: sidecars[0][key] for key in ("dataset", "split", "init") if key in sidecars[0]}
    estimates = [line for part in parts for line in read_results(part)]
    write_results(
        out,
        estimates,
        common
        | {
            "method": out.stem,
            "settings": sidecars[0].get("settings", {}),
            "checkpoints": {
                part.name: sidecar.get("checkpoint_sha256") for part, sidecar in zip(parts, sidecars, strict=True)
            },
            "start_lines": [line for sidecar in sidecars for line in sidecar.get("start_lines", [])],
            "failed_lines": [line for sidecar in sidecars for line in sidecar.get("failed_lines", [])],
        }
        | ({"perturbation": sidecars[0]["perturbation"]} if "perturbation" in sidecars[0] else {}),
    )


def main() -> int:
    """Run from the command line."""
    chosen = parser().parse_args()
    join(chosen.parts, chosen.out)
    return 0


if __name__ == "__main__":
    sys.exit(main())
