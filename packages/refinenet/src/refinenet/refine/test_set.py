"""A trained network on the test images of its dataset: perturbed poses and the same refined, for a report."""

import os
import shlex
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from posecore.bop import BopDataset, read_sidecar
from posecore.bop.perturbation import Level, perturb_dataset
from posecore.bop.results import read_result_table, sidecar_path
from posecore.errors import ConfigError, PoseError
from posecore.files import require_writable, write_atomic
from posecore.shard.layout import TEST_SET

from refinenet import __version__
from refinenet.models import checkpoint
from refinenet.refine.bop_results import RefineJob, RefineSummary, refine_result_file
from refinenet.refine.registry import MethodSettings

RESULTS = Path("results")
"""Folder of result files in the working folder, the one that `evalkit report` reads."""
OWN_RESULTS = Path("test_results")
"""Folder in a run whose `results/` is the working folder's, or holds other poses too."""
INITIAL = "initial.csv"
BEST = "best.safetensors"
PERTURBATION = Level(angle_deg=20.0, translation_diameter=0.2)
"""Largest errors of the initial poses: `evalkit perturb --random-up-to 20 --random-translation 0.2` draws the same."""
SAME_POSE = 1e-6
"""Largest difference in an entry of one pose (metres): other processors round a draw's last digits otherwise."""
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
        note = (
            f"{RESULTS}/ of this folder cannot be written or holds poses of other images "
            f"or another {self.refined.name}, and is left as it is"
        )
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
    poses of other images, or another run's of that name, both are in `results/` of the run, else in `test_results/`.

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
    with TemporaryDirectory() as made:
        drawn = Path(made) / INITIAL
        poses = perturb_dataset(
            dataset, drawn, levels=(), seed=0, random_up_to=PERTURBATION, obj_ids=obj_ids,
            program={"refinenet": __version__},
        )  # fmt: skip
        shared = (folder for folder in (RESULTS, job.run / RESULTS) if _has_room(folder, dataset, drawn, job.run))
        folder = next(shared, None) or _own_folder(dataset, drawn, job.run)
        initial, refined = folder / INITIAL, folder / name
        for source, target in ((sidecar_path(drawn), sidecar_path(initial)), (drawn, initial)):
            write_atomic(target, source.read_bytes())
    method = MethodSettings(checkpoint=best, device=job.device)
    refine = RefineJob(
        method=method, dataset=job.dataset, init=initial, out=refined, threads=job.threads, run=job.run
    )  # fmt: skip
    summary = refine_result_file(refine, on_image)
    return TestSetSummary(initial=initial, refined=refined, poses=poses, summary=summary)


def run_name(run: Path) -> str:
    """Name of a run's result file: `compact` for runs/compact, `a-b` for a/b, `run` for the working folder."""
    parts = [part for part in Path(os.path.normpath(run)).parts if part != os.sep]
    kept = parts[1:] if len(parts) > 1 and parts[0] == "runs" else parts
    name = "-".join("up" if part == ".." else part for part in kept) or "run"
    return f"run-{name}" if f"{name}.csv" == INITIAL else name


def _has_room(folder: Path, dataset: BopDataset, initial: Path, run: Path) -> bool:
    """Whether a folder can hold a run's files: a report of the folder above then compares what belongs together.

    Args:
        folder: Of result files.
        dataset: Test images.
        initial: Poses that the folder's own initial poses, if any, must equal.
        run: Whose refined file is replaced.
    """
    try:
        for path in (path for searched in (folder.parent, folder) for path in sorted(searched.glob("*.csv"))):
            named = (read_sidecar(path) or {}).get("dataset")
            if named and Path(named).resolve() != dataset.root.resolve():
                return False
        if (folder / f"{run_name(run)}.csv").exists() and not _is_of_run(folder, run):
            return False
        if (folder / INITIAL).exists() and not _same_poses(folder / INITIAL, initial, dataset):
            return False
        require_writable(folder / INITIAL)
    except (PoseError, OSError):
        return False
    return True


def _own_folder(dataset: BopDataset, initial: Path, run: Path) -> Path:
    """The folder that a run has for its files alone, which a run in the working folder may find in use."""
    folder = run / OWN_RESULTS
    present = [path for path in (folder / INITIAL, folder / f"{run_name(run)}.csv") if path.exists()]
    is_own = present == [folder / INITIAL] and _same_poses(folder / INITIAL, initial, dataset)
    if present and not is_own and not _is_of_run(folder, run):
        raise ConfigError(f"{present[0]}: is not of this run; move it, and --resume refines the test images")
    return folder


def _is_of_run(folder: Path, run: Path) -> bool:
    """Whether the refined file in a folder is one of this run."""
    return (read_sidecar(folder / f"{run_name(run)}.csv") or {}).get("run") == str(run.resolve())


def _same_poses(file: Path, other: Path, dataset: BopDataset) -> bool:
    a, b = (read_result_table(path, dataset) for path in (file, other))
    ids_a, ids_b = (np.array([table.scene_id, table.im_id, table.obj_id]) for table in (a, b))
    return np.array_equal(ids_a, ids_b) and bool(np.allclose(a.T_cam_obj, b.T_cam_obj, rtol=0.0, atol=SAME_POSE))
