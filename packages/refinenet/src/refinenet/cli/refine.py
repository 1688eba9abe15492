"""`refinenet refine`."""

from pathlib import Path

import click
from posecore.errors import ConfigError

from refinenet.cli.console import progress_bar, start_logging, stoppable
from refinenet.cli.options import FILE, NEW_FILE, device_option, quiet_option, threads_option, verbose_option


@click.command()
@click.option("--checkpoint", required=True, type=FILE, metavar="FILE", help="Trained network (.safetensors).")
@click.option("--dataset", required=True, type=FILE, metavar="DIR", help="BOP dataset with the images.")
@click.option("--split", metavar="NAME", help="Split folder. [test, val, train_pbr, train or the only one]")
@click.option("--init", required=True, type=FILE, metavar="CSV", help="Start poses, a BOP result file.")
@click.option("--out", required=True, type=NEW_FILE, metavar="CSV", help="Refined poses, a BOP result file.")
@click.option("--iterations", type=click.IntRange(1), default=5, help="Most updates of a pose.")
@click.option("--object", "objects", type=int, multiple=True, help="Refine only this object's poses. Repeatable. [all]")
@click.option("--name", help="Method's name in the report. [the preset and the checkpoint's step]")
@click.option("--overlay", type=FILE, metavar="DIR", help="Draw start (red) and refined (green) contours here.")
@device_option
@click.option("--batch", type=click.IntRange(1), default=64, help="Most poses in one forward pass.")
@threads_option
@quiet_option
@verbose_option
def refine(
    checkpoint: Path,
    dataset: Path,
    split: str | None,
    init: Path,
    out: Path,
    iterations: int,
    objects: tuple[int, ...],
    name: str | None,
    overlay: Path | None,
    device: str,
    batch: int,
    threads: int,
    quiet: bool,
    verbose: bool,
) -> None:
    """Refine BOP estimates; the result file's sidecar says with what.

    Exit code 0 also when some poses fail: they keep their start pose, get score 0, and are counted on the last line.

    \b
    refinenet refine --checkpoint best.safetensors --dataset lmo --init start.csv --out results/refined.csv
    refinenet refine --checkpoint best.safetensors --dataset lmo --init start.csv --out ten.csv --iterations 10
    """
    start_logging(verbose)
    import torch
    from posecore.bop import BopDataset, read_results, read_sidecar, write_results

    from refinenet import checkpoint as checkpoints
    from refinenet.estimates import make_sidecar, refine_estimates
    from refinenet.refine import Refiner

    if threads:
        torch.set_num_threads(threads)
    loaded = checkpoints.load(checkpoint)
    bop = BopDataset(dataset, split)
    starts = [s for s in read_results(init, bop) if not objects or s.obj_id in objects]
    if not starts:
        raise ConfigError(f"{init}: no pose of object {', '.join(map(str, objects))}; change --object")
    meshes = {i: bop.mesh(i) for i in sorted({s.obj_id for s in starts})}
    with Refiner(loaded, meshes, device=device, batch=batch) as refiner, stoppable(out), progress_bar(quiet) as bar:
        task = bar.add_task("poses", total=len(starts))
        result = refine_estimates(
            bop, starts, refiner, iterations=iterations, overlay=overlay, on_image=lambda n: bar.advance(task, n)
        )
    method = name or f"refinenet {loaded.provenance.config.preset} step {loaded.provenance.step}"
    sidecar = make_sidecar(
        dataset=bop, loaded=loaded, start_path=init, start_sidecar=read_sidecar(init) or {},
        method=method, iterations=iterations, refined=result,
    )  # fmt: skip
    write_results(out, result.estimates, sidecar)
    click.echo(
        f"{out}: {len(starts)} poses refined, {result.converged} converged, {len(result.failed_lines)} failed"
        + (" (left out of the file: the object could not be seen)" if result.failed_lines else "")
    )
