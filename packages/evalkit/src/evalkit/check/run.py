"""All checks in order: models, annotations, images, targets, ground truth against itself, result files."""

from collections.abc import Callable, Sequence
from pathlib import Path

from posecore.bop import BopDataset
from posecore.bop.results import Extent, extents_of
from posecore.errors import PoseError

from evalkit.check.annotations import check_scenes
from evalkit.check.findings import Findings
from evalkit.check.images import check_images
from evalkit.check.models import check_models
from evalkit.check.results import check_results
from evalkit.check.self_test import check_ground_truth
from evalkit.check.targets import check_targets

SAMPLES = 100


def check(
    dataset: str | Path,
    results: Sequence[str | Path] = (),
    *,
    split: str | None = None,
    sensor: str | None = None,
    samples: int = SAMPLES,
    limit: int | None = 10,
    on_stage: Callable[[str], None] = lambda name: None,
) -> Findings:
    """Check a dataset and result files.

    All annotations, models and result lines are read. Every image has to be present; `samples` images, spread evenly,
    are decoded, and their ground-truth poses evaluated against themselves.

    Args:
        dataset: BOP dataset folder.
        results: result files.
        split: as `BopDataset` takes it.
        sensor: as `BopDataset` takes it.
        samples: images to decode.
        limit: violations of a kind to keep, None for all; every one is counted.
        on_stage: called with the name of the next stage.

    Returns:
        The findings; faults in the files do not raise.
    """
    findings = Findings(limit)
    opened: BopDataset | None = None
    extents: dict[int, Extent] = {}
    try:
        opened = BopDataset(dataset, split, sensor)
    except PoseError as error:
        findings.add_error("dataset", error)
    if opened is not None:
        extents = _check_dataset(opened, samples, findings, on_stage)
    for path in results:
        on_stage(str(path))
        usable = opened if opened is not None and _has_models(opened) else None
        check_results(Path(path), usable, extents, findings)
    return findings


def _check_dataset(
    dataset: BopDataset, samples: int, findings: Findings, on_stage: Callable[[str], None]
) -> dict[int, Extent]:
    on_stage("models")
    infos = check_models(dataset, findings)
    extents = extents_of(dataset, infos)
    on_stage("annotations")
    scenes = check_scenes(dataset, infos, extents, findings)
    on_stage("images")
    chosen = check_images(dataset, scenes, infos, samples, findings)
    on_stage("targets")
    check_targets(dataset, scenes, set(infos), findings)
    if findings.ok:  # else the evaluation would report the same faults again
        on_stage("ground truth against itself")
        check_ground_truth(dataset, scenes, chosen, findings)
    return extents


def _has_models(dataset: BopDataset) -> bool:
    try:
        return bool(dataset.models_info)
    except PoseError:  # reported with the models
        return False
