"""A trained network on the test images of its dataset: perturbed poses and the same refined, for a report."""

import os
import shlex
from collections.abc import Callable, Collection
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from posecore.bop import BopDataset, read_sidecar
from posecore.bop.perturbation import Level, perturb_dataset
from posecore.errors import PoseError
from posecore.files import require_writable
from posecore.shard.layout import TEST_SET

from refinenet import __version__
from refinenet.models import checkpoint
from refinenet.refine.bop_results import RefineJob, RefineSummary, refine_result_file
from refinenet.refine.registry import MethodSettings

RESULTS = Path("results")
"""Folder of result files in the working folder, the one that `evalkit report` reads."""
INITIAL = "initial.csv"
BEST = "best.safetensors"
PERTURBATION = Level(angle_deg=20.0, translation_diameter=0.2)
"""Largest errors of the initial poses: `evalkit perturb --random-up-to 20 --random-translation 0.2` draws the same."""
TARGETS = "test_targets_bop19.json"
"""Last file that the renderer of test images writes."""


@dataclass(frozen=True, kw_only=True)
class TestSetJob:
    """Test images to refine poses in.

    Attributes:
        dataset: BOP dataset.
        run: Folder of the training run, with `best.safetensors`.
        device: Device of the network.
        threads: Torch threads; 0 leaves torch's choice.
    """

    __test__ = False  # no test class

    dataset: Path
    run: Path
    device: str = "auto"
    threads: int = 0


@dataclass(frozen=True, kw_only=True, eq=False)
class TestSetSummary:
    """Result files of a job.

    Attributes:
        initial: File of the initial poses.
        refined: File of the refined poses.
        poses: Number of initial poses.
        summary: Outcome of the refinement.
    """

    __test__ = False

    initial: Path
    refined: Path
    poses: int
    summary: RefineSummary

    @property
    def text(self) -> str:
        """Files and the next command, in lines."""
        failed, left = len(self.summary.refined.failed), self.summary.not_reached
        angle, distance = PERTURBATION.angle_deg, PERTURBATION.translation_diameter
        lines = [
            f"{self.initial}: {self.poses} initial poses in test images, ground truth rotated by up to {angle:g} deg "
            f"and translated by up to {distance:g} diameters",
            f"{self.refined}: the same refined, {failed} failed" + (f", {left} not reached" if left else ""),
        ]
        if self.initial.parent == RESULTS:
            return "\n".join([*lines, "next: evalkit report"])
        named = " ".join(f"--results {shlex.quote(str(path))}" for path in (self.initial, self.refined))
        note = f"{RESULTS}/ of this folder cannot be written or holds poses of other images, and is left as it is"
        return "\n".join([*lines, note, f"next: evalkit report {named}"])


def find_test_set(url: str) -> Path | str:
    """Folder of the test images beside the shards of a dataset, or the reason for none in words."""
    folder = Path(url) / TEST_SET
    if "://" in url or not folder.is_dir():
        return "no test images"
    if not (folder / TARGETS).is_file():
        return "test images are not complete (the same `synthgen render` again completes them)"
    return folder


def refine_test_set(
    job: TestSetJob, on_image: Callable[[int, int], None] = lambda done, total: None
) -> TestSetSummary | None:
    """Write perturbed poses of the trained objects in the test images, and the same refined; None without a target.

    The files are in `results/` of the working folder, the refined one named after the run. If that folder holds
    poses of other images, both are in `results/` of the run.

    Args:
        job: Test images and network.
        on_image: See `refine_result_file`.

    Raises:
        PoseError: The test images or the checkpoint cannot be read, or the files cannot be written.
    """
    best = job.run / BEST
    dataset = BopDataset(job.dataset)
    obj_ids = tuple(sorted(int(key) for key in checkpoint.load(best).provenance.objects))
    if not any(target.obj_id in obj_ids for target in dataset.targets):
        return None
    name = f"{run_name(job.run)}.csv"
    folder = RESULTS if _has_room(dataset, obj_ids, name) else job.run / RESULTS
    initial, refined = folder / INITIAL, folder / name
    poses = _write_initial(dataset, initial, obj_ids)
    method = MethodSettings(checkpoint=best, device=job.device)
    refine = RefineJob(method=method, dataset=job.dataset, init=initial, out=refined, threads=job.threads)
    summary = refine_result_file(refine, on_image)
    return TestSetSummary(initial=initial, refined=refined, poses=poses, summary=summary)


def run_name(run: Path) -> str:
    """Name of a run's result file: `compact` for runs/compact, `a-b` for a/b."""
    parts = [part for part in Path(os.path.normpath(run)).parts if part != os.sep]
    kept = parts[1:] if len(parts) > 1 and parts[0] == "runs" else parts
    name = "-".join("up" if part == ".." else part for part in kept)
    return f"run-{name}" if f"{name}.csv" == INITIAL else name


def _write_initial(dataset: BopDataset, out: Path, obj_ids: Collection[int]) -> int:
    return perturb_dataset(
        dataset, out, levels=(), seed=0, random_up_to=PERTURBATION, obj_ids=obj_ids,
        program={"refinenet": __version__},
    )  # fmt: skip


def _has_room(dataset: BopDataset, obj_ids: Collection[int], name: str) -> bool:
    """Whether `results/` can hold the files: a report of the working folder then compares what belongs together.

    A refined file of that name is replaced if a training run wrote it.
    """
    try:
        require_writable(RESULTS / INITIAL)
        for path in (path for folder in (Path(), RESULTS) for path in sorted(folder.glob("*.csv"))):
            named = (read_sidecar(path) or {}).get("dataset")
            if named and Path(named).resolve() != dataset.root.resolve():
                return False
        present = read_sidecar(RESULTS / name) or {}
        if (RESULTS / name).exists() and (present.get("init"), present.get("checkpoint")) != (INITIAL, BEST):
            return False
        with TemporaryDirectory() as folder:
            _write_initial(dataset, Path(folder) / INITIAL, obj_ids)
            new = (Path(folder) / INITIAL).read_bytes()
        return not (RESULTS / INITIAL).exists() or (RESULTS / INITIAL).read_bytes() == new
    except (PoseError, OSError):
        return False
