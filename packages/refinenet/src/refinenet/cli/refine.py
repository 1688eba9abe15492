"""`refinenet refine`."""

from contextlib import ExitStack, closing
from pathlib import Path
from typing import TYPE_CHECKING

import click
from posecore.command_line import end_early, progress_bar
from posecore.errors import ConfigError, PoseError

from refinenet.cli.options import (
    FILE,
    NEW_FILE,
    checkpoint_option,
    device_option,
    iterations_option,
    method_option,
    other_mesh_option,
    quiet_option,
    require_apart,
    require_fit,
    require_used,
    threads_option,
    verbose_option,
    workers_option,
)
from refinenet.refiner import NETWORK, WITH_CONFIDENCE, WITH_NETWORK

if TYPE_CHECKING:
    from refinenet.refine.multi_hypothesis import PoolScorer

SHOWN_FAILURES = 5


@click.command()
@method_option
@checkpoint_option
@click.option("--dataset", required=True, type=FILE, metavar="DIR", help="BOP dataset with the images.")
@click.option("--split", metavar="NAME", help="Split folder. [test, val, train_pbr, train or the only one]")
@click.option("--init", required=True, type=FILE, metavar="CSV", help="Start poses, a BOP result file.")
@click.option("--out", required=True, type=NEW_FILE, metavar="CSV", help="Refined poses, a BOP result file.")
@iterations_option
@click.option(
    "--hypotheses",
    type=click.IntRange(1),
    default=1,
    help="Poses tried for each start pose: itself, and some around it.",
)
@click.option(
    "--scorer", type=click.Choice(["gradient", "learned", "none"]), default="gradient",
    help="What picks the quarter of the hypotheses that is refined: image gradients, the network; none refines all.",
)  # fmt: skip
@click.option("--seed", type=click.IntRange(0), default=0, help="Of the hypotheses.")
@click.option("--object", "objects", type=int, multiple=True, help="Refine only this object's poses. Repeatable. [all]")
@click.option(
    "--min-confidence",
    type=click.FloatRange(0, 1),
    help="A pose that is less confident fails. [network: 0, search: 0.4, with a network that tells closeness: 0.5]",
)
@click.option("--keep-failed", is_flag=True, help="Write the start pose of one that fails, with score 0. [left out]")
@click.option("--name", help="Method's name in the report. [the preset and the checkpoint's step]")
@click.option("--overlay", type=FILE, metavar="DIR", help="Draw start (red) and refined (green) contours here.")
@click.option(
    "--candidates", type=NEW_FILE, metavar="CSV",
    help="Also write every pose that --method search weighed, with its score: hypotheses for synthgen cut.",
)  # fmt: skip
@device_option
@click.option("--batch", type=click.IntRange(1), default=64, help="Most poses in one forward pass.")
@threads_option
@workers_option
@other_mesh_option
@quiet_option
@verbose_option
def refine(
    method: str,
    checkpoint: Path | None,
    dataset: Path,
    split: str | None,
    init: Path,
    out: Path,
    iterations: int,
    hypotheses: int,
    scorer: "PoolScorer",
    seed: int,
    objects: tuple[int, ...],
    min_confidence: float | None,
    keep_failed: bool,
    name: str | None,
    overlay: Path | None,
    candidates: Path | None,
    device: str,
    batch: int,
    threads: int,
    workers: int,
    allow_other_mesh: bool,
    quiet: bool,
) -> None:
    """Refine BOP estimates; the result file's sidecar says with what.

    A refined pose's score is how well it fits the image, from 0 to 1. Exit code 0 also when some poses fail: they are
    left out of the file (or kept as they were, --keep-failed), named on stderr with the reason, and counted on the
    last line.

    \b
    refinenet refine --checkpoint best.safetensors --dataset lmo --init start.csv --out results/refined.csv
    refinenet refine --checkpoint best.safetensors --dataset lmo --init start.csv --out ten.csv --iterations 10
    refinenet refine --checkpoint best.safetensors --dataset lmo --init start.csv --out pool.csv --hypotheses 16
    refinenet refine --method search --dataset lmo --init start.csv --out searched.csv
    refinenet refine --method search --checkpoint flow.safetensors --dataset lmo --init start.csv --out both.csv
    """
    require_fit(method, checkpoint, WITH_NETWORK)
    if hypotheses > 1 and method != NETWORK:
        raise click.UsageError(f"--hypotheses is for --method network, {method} does without")
    if method != NETWORK:
        require_used(f"for --method {method}", "scorer", "seed")
    if hypotheses == 1:
        require_used("with one hypothesis, see --hypotheses", "scorer", "seed")
    if min_confidence is not None and method not in WITH_CONFIDENCE:
        raise click.UsageError(
            f"--min-confidence is for --method {' and '.join(WITH_CONFIDENCE)}, {method} tells no confidence"
        )
    if candidates is not None and method not in WITH_NETWORK:
        raise click.UsageError(f"--candidates is for --method {WITH_NETWORK[0]}, {method} follows one pose")
    require_apart({"--init": init, "--checkpoint": checkpoint}, {"--out": out, "--candidates": candidates})
    import torch
    from posecore.bop import BopDataset, read_results, read_sidecar, write_results
    from posecore.files import require_writable

    from refinenet.models import checkpoint as checkpoints
    from refinenet.refine.bop_results import (
        ImageStarts,
        OverlayFolder,
        Refined,
        Results,
        add_results,
        by_image,
        make_sidecar,
    )
    from refinenet.refine.workers import MethodSettings, refined_by_workers, refined_here

    if threads:
        torch.set_num_threads(threads)
    loaded = None if checkpoint is None else checkpoints.load(checkpoint)
    bop = BopDataset(dataset, split)
    given = read_results(init, bop, images="camera")
    starts = [s for s in given if not objects or s.obj_id in objects]
    if not given:
        raise ConfigError(f"{init}: no poses in it, there is nothing to refine")
    if missing := sorted(set(objects) - {s.obj_id for s in starts}):
        raise ConfigError(f"{init}: no pose of object {', '.join(map(str, missing))}; change --object")
    start_sidecar = read_sidecar(init) or {}
    for path in filter(None, (out, candidates, overlay and overlay / "overlay.png")):
        require_writable(path)
    obj_ids = tuple(sorted({s.obj_id for s in starts}))
    settings = MethodSettings(
        dataset=dataset, split=bop.split, obj_ids=obj_ids, method=method, checkpoint=checkpoint, iterations=iterations,
        device=device, batch=batch, allow_other_mesh=allow_other_mesh, min_confidence=min_confidence,
        hypotheses=hypotheses, scorer=scorer, seed=seed, threads=threads,
    )  # fmt: skip
    refiner = settings.make(bop, loaded)
    result, stopped, images = Refined(keep_failed=keep_failed), None, by_image(starts)
    try:
        with ExitStack() as stack:
            stack.enter_context(closing(refiner))
            painter = overlay and stack.enter_context(closing(OverlayFolder(bop, obj_ids, overlay)))
            bar = stack.enter_context(progress_bar(quiet))
            task = bar.add_task("poses", total=len(starts))

            def after(image: ImageStarts, results: Results) -> None:
                if painter:
                    painter.write(image, results)
                bar.advance(task, len(image.places))

            if (side_by_side := min(workers, len(images))) > 1:
                results = stack.enter_context(refined_by_workers(settings, images, side_by_side))
            else:
                results = refined_here(bop, refiner, images)
            add_results(result, starts, images, results, on_image=after)
    except (KeyboardInterrupt, PoseError, OSError) as error:
        stopped = error
    if stopped is not None and not result.done:
        end_early(stopped, None)
    sidecar = make_sidecar(
        dataset=bop, method=refiner, name=name or refiner.name, loaded=loaded, start_path=init,
        start_sidecar=start_sidecar, refined=result,
    )  # fmt: skip
    left = len(starts) - len(result.done)
    if left:
        sidecar["not_reached"] = left
    write_results(out, result.estimates, sidecar)
    if candidates is not None:
        of_all = {key: sidecar[key] for key in ("dataset", "split", "settings", "init")}
        write_results(candidates, result.tried, of_all | {"method": f"{sidecar['method']}, all that was weighed"})
    of_line = {start.line: start for start in starts}
    for line, why in list(result.failures.items())[:SHOWN_FAILURES]:
        start = of_line[line]
        where = f"{init}:{line}: scene {start.scene_id}, image {start.im_id}, object {start.obj_id}"
        click.echo(f"Failed: {where}: {why}", err=True)
    if len(result.failures) > SHOWN_FAILURES:
        click.echo(f"Failed: {len(result.failures) - SHOWN_FAILURES} more, listed in {out}.json", err=True)
    click.echo(
        f"{out}: {len(result.done)} start poses, {len(result.done) - len(result.failures)} refined "
        f"({result.converged} converged), {len(result.failures)} failed"
        + (f" ({'start poses kept' if keep_failed else 'left out of the file'})" if result.failures else "")
    )
    if stopped is not None:
        end_early(stopped, f"{left} start poses were not reached, {out} holds the others")
