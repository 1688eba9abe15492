"""From a job to a dataset of pairs cut from annotated images: the application behind `synthgen cut`."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from posecore.bop import BopDataset, splits_of
from posecore.errors import ConfigError

from synthgen import lock
from synthgen.config import CutConfig
from synthgen.machine import require_free_space, size_text
from synthgen.pairs import cut_plan
from synthgen.pairs.cut import cut_pairs
from synthgen.pairs.data_card import create_writer, cut_card, estimated_bytes, model_files


@dataclass(frozen=True, kw_only=True)
class CutJob:
    """A dataset of training pairs to cut from annotated images.

    Attributes:
        dataset: Folder in BOP layout.
        out: Folder or fsspec URL; an unfinished dataset of the same job there is continued.
        config: Settings.
        split: Split folder; None for the only one.
        sensor: Camera of several; None for the only one.
        hypotheses: BOP result file with the hypotheses; None draws them around the annotated poses.
        workers: Processes; the bytes do not depend on their number.
    """

    dataset: Path
    out: str
    config: CutConfig
    split: str | None = None
    sensor: str | None = None
    hypotheses: Path | None = None
    workers: int = 1


@dataclass(frozen=True, kw_only=True)
class CutWork:
    """The work that a job has before its first pair is cut.

    Attributes:
        url: Dataset to write.
        source: Folder of the images.
        pairs: Pairs of the dataset.
        missing_bytes: Estimated size of the missing pairs.
        left_out: Number of poses and hypotheses left out, by reason.
    """

    url: str
    source: str
    pairs: int
    missing_bytes: int
    left_out: Mapping[str, int]

    @property
    def text(self) -> str:
        """The work in lines to read."""
        lines = [f"{self.source}: left out: {count} {reason}" for reason, count in sorted(self.left_out.items())]
        lines.append(f"{self.url}: {self.pairs} pairs of {self.source}, about {size_text(self.missing_bytes)} more")
        return "\n".join(lines)


@dataclass(frozen=True, kw_only=True)
class CutSummary:
    """A complete dataset: its URL, its number of pairs, and the number of images that they are cut from."""

    url: str
    pairs: int
    images: int

    @property
    def text(self) -> str:
        """The summary in one line."""
        return f"{self.url}: complete, {self.pairs} pairs of {self.images} images"


def cut_dataset(
    job: CutJob,
    *,
    on_plan: Callable[[CutWork], None] = lambda plan: None,
    on_shard: Callable[[int], None] = lambda count: None,
) -> CutSummary:
    """Cut a dataset, or the missing shards of an unfinished one.

    Args:
        job: The dataset.
        on_plan: Called once before the first pair is cut.
        on_shard: Called with the number of pairs of each shard, earlier ones included.

    Raises:
        ConfigError: The dataset has several splits and the job names none.
        DatasetError: The images or annotations cannot be used.
        ShardError: The folder holds another dataset.
        StorageError: The disk has no room, the dataset cannot be written, or another process writes it.
    """
    if job.split is None and len(splits := splits_of(job.dataset)) > 1:
        raise ConfigError(
            f"{job.dataset} has the splits {', '.join(splits)}: choose with --split, but no split that you report "
            "results on"
        )
    images = BopDataset(job.dataset, job.split, job.sensor)
    plan = cut_plan.plan(images, job.config, job.hypotheses)
    with lock.held(job.out):
        writer = create_writer(job.out, cut_card(images, plan, job.config, drawn=job.hypotheses is None))
        missing = plan.n - len(writer.committed()) * job.config.shard_size
        size = estimated_bytes(job.config.patch_px, job.config.contour_points, max(0, missing))
        require_free_space(job.out, size)
        on_plan(
            CutWork(
                url=job.out,
                source=str(images.split_path),
                pairs=plan.n,
                missing_bytes=size,
                left_out=dict(plan.left_out),
            )
        )
        infos = images.models_info
        for key, data in model_files(plan.meshes, {i: infos[i] for i in plan.meshes if i in infos}).items():
            writer.add_file(key, data)
        cut_pairs(images, plan, job.config, writer, on_shard, workers=job.workers)
    return CutSummary(url=job.out, pairs=plan.n, images=len(plan.images))
