"""From a job to a BOP dataset of whole images: the application behind `synthgen bop`."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from synthgen.bop.dataset_writer import write_dataset
from synthgen.bop.frame_maker import FramePlan
from synthgen.config import SynthConfig
from synthgen.inputs.sources import Sources


@dataclass(frozen=True, kw_only=True)
class BopJob:
    """A BOP dataset to render.

    Attributes:
        out: Folder; an unfinished dataset of the same job there is continued.
        plan: Images of the dataset.
        config: Recipe.
        sources: Objects, photographs, panoramas, occluders.
        workers: Processes that render.
    """

    out: str
    plan: FramePlan
    config: SynthConfig
    sources: Sources
    workers: int = 1

    @property
    def frames(self) -> int:
        """Number of images in all scenes."""
        return sum(count for _, count in self.plan.scenes())


@dataclass(frozen=True, kw_only=True)
class BopSummary:
    """A complete BOP dataset: its folder and number of images."""

    out: str
    frames: int

    @property
    def text(self) -> str:
        """The summary in one line."""
        return f"{self.out}: complete, {self.frames} frames"


def render_bop_dataset(
    job: BopJob,
    *,
    on_objects: Callable[[Sequence[str]], None] = lambda lines: None,
    on_frame: Callable[[int, int], None] = lambda scene_id, im_id: None,
) -> BopSummary:
    """Render a BOP dataset, or the missing images of an unfinished one.

    Args:
        job: The dataset.
        on_objects: Called once with the objects' diameters, see `Sources.diameter_lines`.
        on_frame: Called with scene and image id of every image that is on disk, earlier ones included.

    Raises:
        PoseError: An input cannot be loaded; or see `dataset_writer.write_dataset`.
    """
    meshes, assets = job.sources.meshes(), job.sources.assets()
    on_objects(job.sources.diameter_lines(meshes))
    infos = job.sources.infos(meshes)
    write_dataset(
        job.out, job.config, meshes, job.plan, assets=assets, infos=infos, workers=job.workers, on_frame=on_frame
    )
    return BopSummary(out=job.out, frames=job.frames)
