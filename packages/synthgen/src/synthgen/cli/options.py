"""Options of several commands, and the scene options that `render` and `bop` share."""

import functools
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import click
from posecore.command_line import stoppable, verbose_option

from synthgen.names import ENGINE_NAMES

F = TypeVar("F", bound=Callable[..., Any])

UNITS = click.Choice(["mm", "cm", "m"])
ENGINE = click.Choice(ENGINE_NAMES)
PATH = click.Path(path_type=Path)
_OUT_HELP = "Dataset to write; the same command again continues it."
required_out = click.option("--out", required=True, type=str, metavar="DIR", help=_OUT_HELP)
shards_out = click.option("--out", type=str, default="shards", metavar="DIR", help=_OUT_HELP)
QUIET = click.option("--quiet", is_flag=True, help="No progress bar.")

LARGE_MESH_BYTES = 20_000_000
"""Of a mesh file whose reading is reported."""
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
"""Parameters of `Sources`."""
_SCENE_OPTIONS = (
    click.option(
        "--object",
        "objects",
        required=True,
        multiple=True,
        type=PATH,
        metavar="MESH|DIR",
        help="Mesh of the object (.ply, .obj, .gltf, .glb, .stl, .off), a folder of meshes, or a BOP models folder. "
        "Repeatable: each scene shows a single object, all equally often. Files named obj_000005.ply keep their "
        "number.",
    ),
    click.option("--units", type=UNITS, default="mm", help="Unit of the mesh's coordinates; glTF is in metres."),
    click.option("--engine", type=ENGINE, help="Renderer of the scenes; raster needs no Blender. [preset]"),
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
        type=PATH,
        metavar="DIR",
        help="Folder of photographs for backgrounds and tables. [procedural backgrounds]",
    ),
    click.option(
        "--hdris", type=PATH, metavar="DIR", help="Folder of panoramas (.hdr, .exr) that light scenes. [lamps only]"
    ),
    click.option(
        "--occluders",
        type=PATH,
        metavar="DIR",
        help="Folder of meshes that hide the object and lie around it, in --units. [primitive shapes]",
    ),
    click.option(
        "--models-info",
        type=PATH,
        metavar="FILE",
        help="BOP models_info.json with symmetries; its keys are object ids or mesh names. [the files in or beside "
        "--object]",
    ),
    click.option(
        "--allow-missing-textures",
        is_flag=True,
        help="Give a mesh whose texture is missing its plain colours instead of stopping.",
    ),
    click.option(
        "--skip-bad-objects", is_flag=True, help="Leave out objects that cannot be loaded, with a line for each."
    ),
    QUIET,
    verbose_option("synthgen"),
)


def scene_options(command: F) -> F:
    """Add the options that decide scenes; the paths among them reach the command as its argument `sources`."""

    @functools.wraps(command)
    def with_sources(**values: Any) -> Any:
        from synthgen.inputs.sources import Sources

        paths = {name: values.pop(name) for name in _SOURCES}
        return command(sources=Sources(**paths, on_load=partial(_report_large, values["quiet"])), **values)

    wrapped: Any = with_sources
    for option in reversed(_SCENE_OPTIONS):
        wrapped = option(wrapped)
    return wrapped


_CLUSTER_OPTIONS = (
    click.option("--scheduler", metavar="ADDRESS", help="Render on a running dask cluster instead, tls://host:port."),
    click.option("--tls-ca", type=PATH, metavar="FILE", help="Authority of that cluster's certificates, PEM."),
    click.option("--tls-cert", type=PATH, metavar="FILE", help="Certificate of this command there, PEM."),
    click.option("--tls-key", type=PATH, metavar="FILE", help="Private key of that certificate, PEM. [in --tls-cert]"),
    click.option(
        "--dashboard",
        is_flag=False,
        flag_value=8787,
        type=click.IntRange(1, 65535),
        metavar="[PORT]",
        help="Show the local processes in dask's web page, http://127.0.0.1:PORT/status, by default 8787. [none]",
    ),
)


def cluster_options(command: F) -> F:
    """Add the options of a cluster; the files among them reach the command as its argument `certificates`."""

    @functools.wraps(command)
    def with_certificates(*, tls_ca: Path | None, tls_cert: Path | None, tls_key: Path | None, **values: Any) -> Any:
        from synthgen.run.cluster import Certificates

        certificates = None
        if tls_ca or tls_cert or tls_key:
            if not (tls_ca and tls_cert):
                raise click.UsageError("--tls-ca and --tls-cert: give both")
            certificates = Certificates(ca=tls_ca, cert=tls_cert, key=tls_key)
        return command(certificates=certificates, **values)

    wrapped: Any = with_certificates
    for option in reversed(_CLUSTER_OPTIONS):
        wrapped = option(wrapped)
    return wrapped


def echo_lines(lines: Sequence[str]) -> None:
    """Lines on stderr, above a progress bar."""
    for line in lines:
        click.echo(line, err=True)


def _report_large(quiet: bool, mesh: Path) -> None:
    """A line for a mesh file that takes seconds to read."""
    from synthgen.machine import size_text

    if not quiet and mesh.is_file() and mesh.stat().st_size >= LARGE_MESH_BYTES:
        click.echo(f"{mesh}: reading {size_text(mesh.stat().st_size)}", err=True)


def resumable(out: str) -> AbstractContextManager[None]:
    """End Ctrl-C with one line: what is in `out` by then, if anything, stays, and the same command continues there."""

    def kept() -> str | None:
        if "://" not in out and not Path(out).exists():
            return None
        return f"what is rendered stays in {out}; the same command again continues"

    return stoppable(kept)
