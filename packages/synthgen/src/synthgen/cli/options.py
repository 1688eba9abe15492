"""Options that decide what scenes look like, shared by `render` and `bop`, and what they name, loaded."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

if TYPE_CHECKING:
    from posecore.mesh import Mesh, Units

F = TypeVar("F", bound=Callable[..., Any])

ENGINES = ("cycles", "eevee", "raster")


def scene_options(command: F) -> F:
    """Options that decide what scenes look like, shared by `render` and `bop`."""
    options = [
        click.option(
            "--object",
            "objects",
            required=True,
            multiple=True,
            type=click.Path(path_type=Path),
            metavar="MESH",
            help="Mesh of the object (.ply, .obj, .gltf, .glb, .stl). Repeat it for several objects: each scene "
            "shows one of them. Files named obj_000005.ply keep their number.",
        ),
        click.option(
            "--out", required=True, type=str, metavar="DIR", help="Where to. The same command again continues it."
        ),
        click.option(
            "--units", type=click.Choice(["mm", "cm", "m"]), default="mm", help="Unit of the mesh's coordinates."
        ),
        click.option(
            "--engine", type=click.Choice(ENGINES), help="Renderer of the scenes; raster needs no Blender. [preset]"
        ),
        click.option(
            "--preset",
            default="default",
            metavar="NAME|FILE",
            help="Shipped preset (default, quickstart) or YAML file.",
        ),
        click.option(
            "--set",
            "overrides",
            multiple=True,
            metavar="KEY=VALUE",
            help="Change one configuration key, e.g. --set window.padding=0.5. Repeatable; last wins.",
        ),
        click.option("--seed", type=click.IntRange(0), help="Dataset seed. [preset, 0]"),
        click.option("--samples", type=click.IntRange(1), help="Light paths per pixel (Blender engines). [preset]"),
        click.option(
            "--backgrounds",
            type=click.Path(path_type=Path),
            metavar="DIR",
            help="Folder of photographs to put behind; without it backgrounds are drawn.",
        ),
        click.option(
            "--models-info",
            type=click.Path(path_type=Path),
            metavar="FILE",
            help="BOP models_info.json to take symmetries from; its keys are object ids or mesh names.",
        ),
        click.option("--quiet", is_flag=True, help="No progress bar."),
        click.option("--verbose", is_flag=True, help="Log details to stderr."),
    ]
    for option in reversed(options):
        command = option(command)
    return command


def load_meshes(objects: tuple[Path, ...], units: "Units") -> "dict[int, Mesh]":
    """The objects by id."""
    from posecore.mesh import load_mesh

    from synthgen.target import object_ids

    ids = object_ids([str(p) for p in objects])
    return {obj_id: load_mesh(path, units=units) for obj_id, path in zip(ids, objects, strict=True)}


def load_photos(folder: Path | None) -> tuple[str, ...]:
    """Photographs of the backgrounds folder, none without one."""
    from synthgen.background import list_photos

    return list_photos(folder.resolve()) if folder is not None else ()


def text(path: Path | None) -> str | None:
    """A path as text."""
    return None if path is None else str(path)
