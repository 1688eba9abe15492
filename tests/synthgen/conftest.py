"""Shared by the tests of synthgen: small configurations over the rasteriser and the example object."""

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from posecore.mesh import Mesh, load_mesh
from synthgen.config import SynthConfig, load_config
from synthgen.draw.target import TargetObject, make_target
from synthgen.pairs.pair_maker import PairMaker

SMALL = (
    "engine=raster",
    "patch_px=48",
    "contour_points=20",
    "hypotheses_per_scene=2",
    "shard_size=4",
    "window.min_area_px=20",
    "occluders.library=8",
)

ConfigOf = Callable[..., SynthConfig]
MakerOf = Callable[..., PairMaker]


@pytest.fixture(scope="session")
def config_of() -> ConfigOf:
    """Makes a small configuration with further overrides."""
    return lambda *overrides: load_config("default", [*SMALL, *overrides])


@pytest.fixture(scope="session")
def small_set() -> list[str]:
    """The small configuration as command-line arguments."""
    return [word for assignment in SMALL for word in ("--set", assignment)]


@pytest.fixture(scope="session")
def tug(tug_ply: Path) -> Mesh:
    """The example object."""
    return load_mesh(tug_ply)


@pytest.fixture(scope="session")
def tug_target(tug: Mesh, config_of: ConfigOf) -> TargetObject:
    """The example object, prepared."""
    return make_target(1, tug, config_of())


@pytest.fixture
def maker_of(tug: Mesh, config_of: ConfigOf) -> Iterator[MakerOf]:
    """Makes pair makers of small configurations and closes them."""
    made: list[PairMaker] = []

    def make(*overrides: str) -> PairMaker:
        config = config_of(*overrides)
        made.append(PairMaker(config, [make_target(1, tug, config)], threads=1))
        return made[-1]

    yield make
    for maker in made:
        maker.close()
