"""`evalkit perturb`."""

from pathlib import Path

import click

from evalkit.cli.options import FOLDER, NEW_FILE, Numbers, split_option, verbose_option


@click.command()
@click.option("--dataset", type=FOLDER, required=True, help="BOP dataset folder with ground truth.")
@click.option("--out", type=NEW_FILE, required=True, help="Result file to write; its sidecar goes beside it.")
@split_option
@click.option(
    "--protocol",
    type=click.Choice(["paper"]),
    help="Levels of a published experiment. paper: rotations of 5 ... 45 degrees, translations of 0 ... 1 diameters.",
)
@click.option("--angles", type=Numbers(), default=(), help="Rotations, degrees: one initial pose for each.")
@click.option(
    "--translations", type=Numbers(), default=(), help="Translations, object diameters: one initial pose for each."
)
@click.option(
    "--random-up-to", type=click.FloatRange(0, 180), help="Adds a random initial pose; its largest rotation, degrees."
)
@click.option(
    "--random-translation",
    type=click.FloatRange(0),
    help="Largest translation of the random initial pose, object diameters. Default: 0.",
)
@click.option(
    "--depth-stretch",
    type=click.FloatRange(1, 20),
    default=1.0,
    help="Factor on the random translation along the viewing ray: RGB detectors err most in depth.",
)
@click.option("--seed", type=click.IntRange(0), default=0, help="Seed of all draws.")
@verbose_option
def perturb(
    dataset: Path,
    out: Path,
    split: str | None,
    protocol: str | None,
    angles: tuple[float, ...],
    translations: tuple[float, ...],
    random_up_to: float | None,
    random_translation: float | None,
    depth_stretch: float,
    seed: int,
) -> None:
    """Write initial poses: ground truth rotated and translated by given amounts.

    The sidecar records the level of every line, for the convergence curves of `evalkit report`.

    \b
    Examples:
      evalkit perturb --dataset lmo --out initial.csv --random-up-to 20 --random-translation 0.2
      evalkit perturb --dataset lmo --out initial.csv --random-up-to 60 --random-translation 0.3 --depth-stretch 6
      evalkit perturb --dataset lmo --out curve.csv --angles 5,10,15,30,45 --translations 0.1,0.5,1
      evalkit perturb --dataset lm --out curve.csv --protocol paper
    """
    from posecore.bop.perturbation import Level
    from posecore.errors import ConfigError

    from evalkit.inputs.perturbation import PROTOCOLS, PerturbJob, write_initial_poses

    limit = None
    if random_up_to is not None or random_translation is not None:
        limit = Level(angle_deg=random_up_to or 0.0, translation_diameter=random_translation or 0.0)
    job = PerturbJob(
        dataset=dataset,
        out=out,
        split=split,
        protocol=protocol,
        angles_deg=angles,
        translations_diameter=translations,
        random_up_to=limit,
        depth_stretch=depth_stretch,
        seed=seed,
    )
    try:
        count = write_initial_poses(job)
    except ConfigError as error:
        raise ConfigError(_with_options(str(error))) from error
    click.echo(f"{count} initial poses: {out}")
    if protocol is not None:
        click.echo(f"Protocol '{protocol}' refines them in {PROTOCOLS[protocol].iterations} iterations.")


def _with_options(message: str) -> str:
    """An error of `perturb_dataset` about its parameters, with options for them; one that names a file as it is."""
    if not message.startswith("depth_stretch "):
        return message
    message = message.replace("depth_stretch", "--depth-stretch", 1)
    return message.replace("random_up_to.translation_diameter", "--random-translation")
