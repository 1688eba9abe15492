"""`synthgen cut`."""

from pathlib import Path

import click
from posecore.command_line import progress_bar

from synthgen.cli.options import resumable


@click.command()
@click.argument("dataset", type=click.Path(path_type=Path))
@click.option("--out", required=True, type=str, metavar="DIR", help="Where to. The same command again continues it.")
@click.option(
    "--split",
    metavar="NAME",
    help="Split folder of the dataset. [the only one]",
)
@click.option("--sensor", metavar="NAME", help="Which camera of several, as in scene_camera_NAME.json.")
@click.option(
    "--hypotheses",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="BOP result file: each line is a hypothesis of the nearest annotated instance of its object; images without "
    "a line give no pair. [drawn around the annotated poses]",
)
@click.option("--images", type=click.IntRange(0), help="Most images to cut, evenly spread over all; 0 cuts all. [0]")
@click.option("--patch-px", type=int, help="Side of the patches. [224]")
@click.option("--hypotheses-per-pose", type=int, help="Hypotheses drawn around each annotated pose. [8]")
@click.option("--seed", type=click.IntRange(0), help="Of drawn hypotheses. [0]")
@click.option(
    "--set",
    "overrides",
    multiple=True,
    metavar="KEY=VALUE",
    help="Change one configuration key: seed, patch_px, contour_points, hypotheses_per_pose, shard_size, min_visible, "
    "min_area_px, images, window, scale, padding, perturbation.max_angle_deg, ... Repeatable; last wins.",
)
@click.option("--workers", type=click.IntRange(1), default=1, help="Processes; the bytes do not depend on it.")
@click.option("--quiet", is_flag=True, help="No progress bar.")
def cut(
    dataset: Path,
    out: str,
    split: str | None,
    sensor: str | None,
    hypotheses: Path | None,
    overrides: tuple[str, ...],
    workers: int,
    quiet: bool,
    **values: int | None,
) -> None:
    """Cut training pairs out of the annotated images of DATASET, a folder in BOP layout.

    For training on real images, or on the errors of a detector or of a refinement, whose result file --hypotheses
    takes. Poses that are hidden and hypotheses that their windows do not hold are left out, and counted. Never train
    on images that you report results on.

    \b
    synthgen cut ycbv --split train_real --images 5000 --out shards
    synthgen cut my_images --out shards --hypotheses detections.csv
    synthgen cut my_images --out shards --set perturbation.max_angle_deg=20 --patch-px 160
    """
    from posecore.bop import BopDataset, splits_of
    from posecore.shard import ShardWriter

    from synthgen.config import load_cut_config
    from synthgen.machine import size_text
    from synthgen.pairs import cut_plan
    from synthgen.pairs.cut import cut_pairs
    from synthgen.pairs.data_card import estimated_bytes, model_files
    from synthgen.run import lock
    from synthgen.run.estimate import check_free_space

    config = load_cut_config(overrides, values)
    if split is None and len(there := splits_of(dataset)) > 1:
        raise click.UsageError(
            f"{dataset} has the splits {', '.join(there)}: name one with --split, not one that you report results on"
        )
    images = BopDataset(dataset, split, sensor)
    planned = cut_plan.plan(images, config, hypotheses)
    for reason, count in sorted(planned.left_out.items()):
        click.echo(f"{images.split_path}: left out: {count} {reason}", err=True)
    with lock.held(out), resumable(out):
        writer = ShardWriter.create(out, cut_plan.make_card(images, planned, config, drawn=hypotheses is None))
        missing = planned.n - len(writer.committed()) * config.shard_size
        size = estimated_bytes(config.patch_px, config.contour_points, max(0, missing))
        check_free_space(out, size)
        click.echo(f"{out}: {planned.n} pairs of {images.split_path}, about {size_text(size)} more", err=True)
        infos = images.models_info
        for key, data in model_files(planned.meshes, {i: infos[i] for i in planned.meshes if i in infos}).items():
            writer.add_file(key, data)
        with progress_bar(quiet) as bar:
            task = bar.add_task("pairs", total=planned.n)
            cut_pairs(images, planned, config, writer, lambda count: bar.advance(task, count), workers=workers)
    click.echo(f"{out}: complete, {planned.n} pairs of {len(planned.images)} images", err=True)
