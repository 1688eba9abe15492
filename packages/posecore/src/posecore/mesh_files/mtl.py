"""MtlMaterial libraries of OBJ files (MTL): the colour, the texture and the opacity of each material.

Honoured: `Kd`, `map_Kd` with `-s`, `-o` and `-clamp`, `d`, `Tr` and `map_d`, in any case, after tabs or spaces.
Left to the scene, as the finish of a material is: `Ka`, `Ks`, `Ns`, `Ke`, `illum`, `Pr`, `Pm` and the maps of these,
`bump`, `norm` and `refl`. What else changes the colour or the shape is refused with its line.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from posecore.errors import MeshError

_NUMBERS = {"-o": 3, "-s": 3, "-t": 3, "-mm": 2, "-boost": 1, "-bm": 1, "-texres": 1}
"""Options with numbers, and how many they take at most."""
_WORDS = ("-blendu", "-blendv", "-cc", "-clamp", "-imfchan", "-type")
_REFUSED = {"disp": "a displacement map", "decal": "a decal", "map_kd_add": "a second colour map"}
NEARLY_OPAQUE = 0.99
HOLE = 0.1
"""Opacity below which a surface counts as a hole in the silhouette."""


@dataclass(frozen=True, kw_only=True)
class MaterialMap:
    """An image of a material, and where it lies on the surface: `uv * scale + offset`."""

    name: str
    line: str
    scale: tuple[float, float] = (1.0, 1.0)
    offset: tuple[float, float] = (0.0, 0.0)
    clamp: bool = False


@dataclass(frozen=True, kw_only=True)
class MtlMaterial:
    """What an MTL file gives for one material.

    Attributes:
        file: The MTL file.
        Kd: Diffuse colour, display values; None where it has none.
        map_Kd: Image of the diffuse colour.
        map_d: Image of the opacity.
        opacity: 1 is opaque.
        opacity_line: The line that gives it.
        fault: Reason why faces with this material cannot be drawn as the file gives it; empty without one.
    """

    file: Path
    Kd: tuple[float, float, float] | None = None
    map_Kd: MaterialMap | None = None
    map_d: MaterialMap | None = None
    opacity: float = 1.0
    opacity_line: str = ""
    fault: str = ""


def read_materials(file: Path, text: str) -> dict[str, MtlMaterial]:
    """Materials of an MTL file by name; the last of one name counts, as in other readers.

    A fault of a material that no face uses is no fault of the mesh, so that it is kept in the material.
    """
    materials: dict[str, MtlMaterial] = {}
    name: str | None = None
    for number, line in enumerate(text.splitlines(), 1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        key, rest = words[0].lower(), line.strip()[len(words[0]) :].strip()
        if key == "newmtl":
            name = rest
            materials[name] = MtlMaterial(file=file)
        elif name is not None:
            where = f"{file}:{number}: '{line.strip()[:60]}'"
            try:
                materials[name] = _with_line(materials[name], key, rest, where)
            except (ValueError, MeshError) as error:
                fault = str(error) if isinstance(error, MeshError) else f"{where} cannot be read; expected numbers"
                materials[name] = replace(materials[name], fault=materials[name].fault or fault)
    return materials


def _with_line(material: MtlMaterial, key: str, rest: str, where: str) -> MtlMaterial:
    if key == "kd":
        return replace(material, Kd=_colour(rest, where))
    if key in ("map_kd", "map_d"):
        entry = _map(rest, where)
        return replace(material, map_Kd=entry) if key == "map_kd" else replace(material, map_d=entry)
    if key == "d":
        words = rest.split()
        opacity = float(words[-1] if words else "")
        return replace(material, opacity=opacity, opacity_line=where)
    if key == "tr" and not material.opacity_line:
        # MeshLab writes `Tr 1` for opaque materials: nobody exports what cannot be seen at all.
        see_through = float(rest.split()[0] if rest else "")
        return replace(material, opacity=1.0 if see_through >= 1.0 else 1.0 - see_through)
    if key in _REFUSED:
        raise MeshError(f"{where} is {_REFUSED[key]}, which is not drawn; bake it into the mesh or remove the line")
    return material


def _colour(rest: str, where: str) -> tuple[float, float, float]:
    words = rest.split("#")[0].split()
    if words and words[0].lower() in ("spectral", "xyz"):
        raise MeshError(f"{where} is no RGB colour; expected three numbers from 0 to 1")
    numbers = [float(word) for word in words[:3]]
    if len(numbers) == 1:
        numbers *= 3
    if len(numbers) != 3 or not np.isfinite(numbers).all() or min(numbers) < 0 or max(numbers) > 1:
        raise MeshError(f"{where} is no colour; expected three numbers from 0 to 1")
    return numbers[0], numbers[1], numbers[2]


def _map(rest: str, where: str) -> MaterialMap:
    """An image with its options, which stand before its name; the name may hold spaces."""
    scale, offset, clamp = (1.0, 1.0), (0.0, 0.0), False
    while rest.startswith("-"):
        words = rest.split()
        option, arguments = words[0].lower(), words[1:]
        if option in _NUMBERS:
            numbers = _leading_numbers(arguments, _NUMBERS[option])
            if not numbers:
                raise MeshError(f"{where}: {option} has no number; mend the line")
            taken = len(numbers)
            if option == "-s":
                scale = (numbers[0], numbers[1] if taken > 1 else 1.0)
            elif option == "-o":
                offset = (numbers[0], numbers[1] if taken > 1 else 0.0)
            elif (option == "-t" and any(numbers)) or (option == "-mm" and numbers not in ([0.0], [0.0, 1.0])):
                raise MeshError(f"{where}: {option} changes the image, which is not drawn; bake it into the image")
        elif option in _WORDS and arguments:
            taken = 1
            clamp = arguments[0].lower() == "on" if option == "-clamp" else clamp
            if option == "-type":
                raise MeshError(f"{where}: {option} is for reflections; remove it")
        else:
            raise MeshError(f"{where}: the option {option} is not one of map_Kd; remove it")
        for word in words[: taken + 1]:
            rest = rest[len(word) :].lstrip()
    if not rest:
        raise MeshError(f"{where} names no image; name one or remove the line")
    return MaterialMap(name=rest, line=where, scale=scale, offset=offset, clamp=clamp)


def _leading_numbers(words: list[str], most: int) -> list[float]:
    numbers: list[float] = []
    for word in words[:most]:
        try:
            numbers.append(float(word))
        except ValueError:
            break
    return numbers if len(numbers) < len(words) else numbers[:-1]  # the last word is the image's name
