"""`evalkit tracking`."""

from pathlib import Path

import click

from evalkit.cli.options import FOLDER, NEW_FILE, split_option, verbose_option


@click.command()
@click.option("--dataset", type=FOLDER, help="BOP dataset folder. Default: the one the results' sidecars name.")
@click.option(
    "--results", multiple=True, required=True, type=FOLDER, help="Result file of a tracker; repeat it to compare."
)
@split_option
@click.option("--scene", "scenes", multiple=True, type=int, help="Only this sequence; repeat it for more.")
@click.option("--object", "objects", multiple=True, type=int, help="Only this object; repeat it for more.")
@click.option("--all-frames", is_flag=True, help="Every annotated pose counts, not only the targets.")
@click.option("--choi-legacy", is_flag=True, help="Angles as in old tables: unwrapped Euler angles, subtracted.")
@click.option("--by-axis", is_flag=True, help="The paper's layout: a row for each axis, a column for each file.")
@click.option(
    "--resamples",
    type=click.IntRange(0),
    default=0,
    help="For 95 % intervals of the means over sequences; 1000 are enough.",
)
@click.option("--out", multiple=True, type=NEW_FILE, help="Also write a file: .md, .tex, .csv or .json. Repeatable.")
@verbose_option
def tracking(
    dataset: Path | None,
    results: tuple[Path, ...],
    split: str | None,
    scenes: tuple[int, ...],
    objects: tuple[int, ...],
    all_frames: bool,
    choi_legacy: bool,
    by_axis: bool,
    resamples: int,
    out: tuple[Path, ...],
) -> None:
    """Score tracked sequences: RMS by axis, frames within 5 cm and 5 degrees, jitter, lost frames, time.

    A scene of the dataset is a sequence, its images in rising order the frames. Where a tracker was set back to the
    truth after failures (RBOT's protocol), the result file's sidecar says so as
    "resets": [{"scene_id": 1, "im_id": 0, "obj_id": 5}, ...], the first frame of each sequence included.

    \b
    Examples:
      evalkit tracking --dataset choi --results track.csv
      evalkit tracking --results ours.csv --results theirs.csv --by-axis --out table.tex --out table.csv
    """
    from posecore.bop import BopDataset
    from posecore.errors import ConfigError

    from evalkit.inputs.result_files import dataset_of, load_result_files
    from evalkit.tables.model import markdown, require_suffixes, write_tables
    from evalkit.tracking import axis_table, frames_of, named_tracks, sequence_table, tracks_of

    require_suffixes(out)
    opened = BopDataset(dataset or dataset_of(results, Path()), split)
    files = load_result_files(results, opened)
    tracks = [
        [
            track
            for track in tracks_of(opened, file, *frames_of(opened, file, all_frames=all_frames))
            if (not scenes or track.scene_id in scenes) and (not objects or track.obj_id in objects)
        ]
        for file in files
    ]
    if not any(tracks):
        raise ConfigError(f"{opened.root}: none of its targets has this --scene and --object; leave one of them away")
    named = named_tracks(files, tracks)
    if by_axis:
        table = axis_table(named, choi_legacy=choi_legacy)
    else:
        table = sequence_table(named, choi_legacy=choi_legacy, resamples=resamples)
    click.echo(markdown(table), nl=False)
    for path in out:
        for written in write_tables(path, [table]):
            click.echo(f"Table: {written}")
