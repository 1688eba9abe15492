"""Tracking scores of result files as one table."""

from dataclasses import dataclass
from pathlib import Path

from posecore.errors import ConfigError

from evalkit.inputs.result_files import load_result_files, open_dataset
from evalkit.tables.model import Table
from evalkit.tables.writers import require_suffixes, write_tables
from evalkit.tracking.tables import axis_table, named_tracks, sequence_table
from evalkit.tracking.tracks import SequenceTrack, frames_of, tracks_of


@dataclass(frozen=True, kw_only=True)
class TrackingJob:
    """A table of tracking scores to make.

    Attributes:
        results: result files of trackers.
        dataset: BOP folder with ground truth; by default the one that the sidecars name.
        split: of the dataset.
        scenes: sequences to score; all without any.
        objects: objects to score; all without any.
        all_frames: score every annotated pose, not only the targets.
        by_axis: the paper's layout, a row for each axis, instead of a row for each sequence.
        resamples: for 95 % bootstrap intervals of the means over sequences, 0 for none.
        seed: of the resampling.
        out: files to write, .md, .tex, .csv or .json.
    """

    results: tuple[Path, ...]
    dataset: Path | None = None
    split: str | None = None
    scenes: tuple[int, ...] = ()
    objects: tuple[int, ...] = ()
    all_frames: bool = False
    by_axis: bool = False
    resamples: int = 0
    seed: int = 0
    out: tuple[Path, ...] = ()

    def __post_init__(self) -> None:
        require_suffixes(self.out)


def make_tracking_table(job: TrackingJob) -> tuple[Table, list[Path]]:
    """The table of a job, and the files written.

    Raises:
        ConfigError: no target is of the job's scenes and objects.
        PoseError: a file or the dataset is not usable; the message names it.
    """
    dataset, results = open_dataset(job.results, job.dataset, job.split)
    files = load_result_files(results, dataset)
    tracks = []
    for file in files:
        expected = frames_of(dataset, file, all_frames=job.all_frames)
        tracks.append([track for track in tracks_of(dataset, file, *expected) if _is_scored(track, job)])
    if not any(tracks):
        raise ConfigError(f"{dataset.root}: none of its targets has this --scene and --object; leave either out")
    named = named_tracks(files, tracks)
    table = axis_table(named) if job.by_axis else sequence_table(named, resamples=job.resamples, seed=job.seed)
    return table, [written for path in job.out for written in write_tables(path, [table])]


def _is_scored(track: SequenceTrack, job: TrackingJob) -> bool:
    return (not job.scenes or track.scene_id in job.scenes) and (not job.objects or track.obj_id in job.objects)
