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
    help="Levels of a published experiment. paper: rotated by 5, 10 ... 45 degrees, moved by 0, 0.1 ... 1 diameters.",
)
@click.option("--angles", type=Numbers(), default=(), help="Rotations, degrees: one start for each.")
@click.option("--translations", type=Numbers(), default=(), help="Translations, object diameters: one start for each.")
@click.option("--random-up-to", type=click.FloatRange(0, 180), help="One more start, rotated by 0 to this, degrees.")
@click.option(
    "--random-translation",
    type=click.FloatRange(0),
    help="The random start is moved by 0 to this, object diameters. Default: 0.",
)
@click.option(
    "--depth-stretch",
    type=click.FloatRange(1, 20),
    default=1.0,
    help="Factor on the random start's move along the viewing ray: detectors that see RGB alone err most in depth.",
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
    """Write start poses: ground truth rotated and moved by known amounts.

    The sidecar records the level of every line, from which `evalkit report` draws convergence curves.

    \b
    Examples:
      evalkit perturb --dataset lmo --out start.csv --random-up-to 20 --random-translation 0.2
      evalkit perturb --dataset lmo --out start.csv --random-up-to 60 --random-translation 0.3 --depth-stretch 6
      evalkit perturb --dataset lmo --out curve.csv --angles 5,10,15,30,45 --translations 0.1,0.5,1
      evalkit perturb --dataset lm --out curve.csv --protocol paper
    """
    from posecore.bop import BopDataset
    from posecore.errors import ConfigError

    from evalkit.inputs.pairing import Level
    from evalkit.inputs.perturbation import PROTOCOLS, levels_of, perturb_dataset

    if protocol is not None:
        if angles or translations:
            raise ConfigError(f"--protocol {protocol} brings its own levels; leave --angles and --translations away")
        angles, translations = PROTOCOLS[protocol].angles_deg, PROTOCOLS[protocol].translations_diameter
    limit = None
    if random_up_to is not None or random_translation is not None:
        limit = Level(angle_deg=random_up_to or 0.0, translation_diameter=random_translation or 0.0)
    if depth_stretch != 1 and not random_translation:
        raise ConfigError("--depth-stretch is for random starts; give --random-translation too")
    count = perturb_dataset(
        BopDataset(dataset, split),
        out,
        levels=levels_of(angles, translations),
        seed=seed,
        random_up_to=limit,
        depth_stretch=depth_stretch,
        protocol=protocol,
    )
    click.echo(f"{count} start poses: {out}")
    if protocol is not None:
        click.echo(f"Protocol '{protocol}' refines them in {PROTOCOLS[protocol].iterations} iterations.")
