"""Options that decide what scenes look like, shared by `render` and `bop`."""

import functools
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, TypeVar

import click
from posecore.command_line import stoppable, verbose_option

F = TypeVar("F", bound=Callable[..., Any])

ENGINES = ("cycles", "eevee", "raster")


_SOURCES = (
    "objects",
    "units",
    "backgrounds",
    "hdris",
    "occluders",
    "models_info",
    "allow_missing_textures",
    "skip_bad_objects",
)


def scene_options(command: F) -> F:
    """Options that decide what scenes look like; those that name files reach the command as one `sources` argument."""

    @functools.wraps(command)
    def with_sources(**values: Any) -> Any:
        from synthgen.inputs.sources import Sources

        return command(sources=Sources(**{name: values.pop(name) for name in _SOURCES}), **values)

    options = [
        click.option(
            "--object",
            "objects",
            required=True,
            multiple=True,
            type=click.Path(path_type=Path),
            metavar="MESH|DIR",
            help="Mesh of the object (.ply, .obj, .gltf, .glb, .stl), a folder of meshes, or a BOP models folder. "
            "Repeat it for several objects: each scene shows one of them, all equally often. Files named "
            "obj_000005.ply keep their number.",
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
            help="Shipped preset (category, choi, default, linemod, pbr, quickstart, tabletop, tejani) or YAML file.",
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
            help="Folder of photographs to put behind and on tables; without it backgrounds are drawn.",
        ),
        click.option(
            "--hdris",
            type=click.Path(path_type=Path),
            metavar="DIR",
            help="Folder of panoramas (.hdr, .exr) to light scenes with; without it there are lamps only.",
        ),
        click.option(
            "--occluders",
            type=click.Path(path_type=Path),
            metavar="DIR",
            help="Folder of meshes that hide the object and lie around it, in --units; without it primitive shapes.",
        ),
        click.option(
            "--models-info",
            type=click.Path(path_type=Path),
            metavar="FILE",
            help="BOP models_info.json to take symmetries from; its keys are object ids or mesh names. [those "
            "in or beside --object]",
        ),
        click.option(
            "--allow-missing-textures",
            is_flag=True,
            help="Give a mesh whose texture is missing its plain colours instead of stopping.",
        ),
        click.option(
            "--skip-bad-objects", is_flag=True, help="Leave out objects that cannot be loaded, with a line for each."
        ),
        click.option("--quiet", is_flag=True, help="No progress bar."),
        verbose_option("synthgen"),
    ]
    wrapped: Any = with_sources
    for option in reversed(options):
        wrapped = option(wrapped)
    return wrapped


def resumable(out: str) -> AbstractContextManager[None]:
    """End Ctrl-C with one line: what was rendered stays, and the command continues it."""
    return stoppable(lambda: f"what is rendered stays in {out}; the same command again continues")
