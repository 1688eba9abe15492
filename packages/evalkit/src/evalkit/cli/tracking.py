"""`evalkit tracking`."""

from pathlib import Path

import click
from posecore.command_line import renamed_options

from evalkit.cli.options import FOLDER, NEW_FILE, split_option, verbose_option


@click.command()
@click.option("--dataset", type=FOLDER, help="BOP dataset folder. Default: the one the results' sidecars name.")
@click.option(
    "--results", multiple=True, required=True, type=FOLDER, help="Result file of a tracker; repeat it to compare."
)
@split_option
@click.option("--scene", "scenes", multiple=True, type=int, help="Only this sequence. Repeatable.")
@click.option("--object", "objects", multiple=True, type=int, help="Only this object. Repeatable.")
@click.option("--all-frames", is_flag=True, help="Score every annotated pose, not only the targets.")
@renamed_options({"--choi-legacy": "obsolete: angles are those of the residual rotation"})
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
    by_axis: bool,
    resamples: int,
    out: tuple[Path, ...],
) -> None:
    """Score tracked sequences: RMS by axis, frames within 5 cm and 5 degrees, jitter, lost frames, time.

    A scene of the dataset is a sequence, its images in rising order the frames. For a tracker that was reset
    to the ground truth after failures (RBOT's protocol), the result file's sidecar lists these frames as
    "resets": [{"scene_id": 1, "im_id": 0, "obj_id": 5}, ...], the first frame of each sequence included.

    \b
    Examples:
      evalkit tracking --dataset choi --results track.csv
      evalkit tracking --results ours.csv --results theirs.csv --by-axis --out table.tex --out table.csv
    """
    from evalkit.tables.markdown import markdown
    from evalkit.tracking.job import TrackingJob, make_tracking_table

    job = TrackingJob(
        results=results,
        dataset=dataset,
        split=split,
        scenes=scenes,
        objects=objects,
        all_frames=all_frames,
        by_axis=by_axis,
        resamples=resamples,
        out=out,
    )
    table, written = make_tracking_table(job)
    click.echo(markdown(table), nl=False)
    for path in written:
        click.echo(f"Table: {path}")
