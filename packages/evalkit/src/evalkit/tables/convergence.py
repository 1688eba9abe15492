"""Tables of convergence from perturbed initial poses, by level of perturbation."""

from collections.abc import Mapping, Sequence

from evalkit.scores.convergence import KINDS, LIMITS_DEG, LIMITS_DIAMETERS, Curves, Point
from evalkit.tables.model import Better, Cell, Interval, Row, Table, TableColumn


def _fraction_column(key: str, heading: str, group: str, better: Better = "higher") -> TableColumn:
    return TableColumn(key=key, heading=heading, group=group, unit="%", digits=1, better=better)


FRACTION_COLUMNS = (
    *(_fraction_column(f"under_{limit:g}deg", f"{limit:g}°", "rotation under") for limit in LIMITS_DEG),
    *(_fraction_column(f"te_under_{limit:g}d", f"{limit:g} d", "translation under") for limit in LIMITS_DIAMETERS),
    _fraction_column("diverged", "diverged", "", "lower"),
)
MEAN_COLUMNS = (
    TableColumn(
        key="re_sym_deg_mean", heading="rotation", group="mean final error", unit="deg", digits=2, better="lower"
    ),
    TableColumn(key="te_mm_mean", heading="translation", group="mean final error", unit="mm", digits=2, better="lower"),
)
LEVEL_HEADINGS = {"angle": ("rotated by", "deg"), "translation": ("translated by", "diameters")}
TITLES = {"angle": "Initial poses rotated by steps", "translation": "Initial poses translated by steps"}


def level_tables(curves: Mapping[str, Curves]) -> list[Table]:
    """One table for each kind of perturbation: a row for each level of each method, the best of a level bold.

    Args:
        curves: of `by_level`, by the method's name.
    """
    return [
        _table(kind, [("", name, by_kind[kind]) for name, by_kind in curves.items() if kind in by_kind])
        for kind in KINDS
        if any(kind in by_kind for by_kind in curves.values())
    ]


def level_object_tables(curves: Mapping[str, Mapping[int, Curves]]) -> list[Table]:
    """The same with a block for each object; `curves` are of `by_level_and_object`, by the method's name."""
    obj_ids = sorted({obj_id for by_kind in curves.values() for obj_id in by_kind})
    tables = []
    for kind in KINDS:
        blocks = [
            (str(obj_id), name, by_kind[obj_id][kind])
            for obj_id in obj_ids
            for name, by_kind in curves.items()
            if kind in by_kind.get(obj_id, {})
        ]
        if blocks:
            tables.append(_table(kind, blocks))
    return tables


def _table(kind: str, blocks: Sequence[tuple[str, str, list[Point]]]) -> Table:
    """A table from curves, each of an object (empty for all together) and a method."""
    objects = any(obj_id for obj_id, _, _ in blocks)
    methods = len({method for _, method, _ in blocks}) > 1
    heading, unit = LEVEL_HEADINGS[kind]
    levels = [point["level"] for _, _, points in blocks for point in points]
    columns = [TableColumn(key="object", heading="object")] if objects else []
    columns += [TableColumn(key="level", heading=heading, unit=unit, digits=_digits(levels))]
    columns += [TableColumn(key="method", heading="method")] if methods else []
    columns += [
        TableColumn(key="expected", heading="initial poses", digits=0),
        TableColumn(key="found", heading="found", digits=0),
    ]
    rows = []
    for obj_id, method, points in blocks:
        for point in points:
            cells = {name: _cell(point, name) for name in (c.key for c in (*FRACTION_COLUMNS, *MEAN_COLUMNS))}
            cells |= {"level": point["level"], "expected": point["expected"], "found": point["found"]}
            cells |= ({"object": obj_id} if objects else {}) | ({"method": method} if methods else {})
            group = f"{obj_id} {point['level']:g}" if methods else obj_id
            rows.append((obj_id, point["level"], Row(cells=cells, group=group)))
    if methods:  # methods of a level one below the other; the sort is stable
        order = {obj_id: index for index, obj_id in enumerate(dict.fromkeys(obj_id for obj_id, _, _ in blocks))}
        rows.sort(key=lambda row: (order[row[0]], row[1]))
    return Table(
        title=TITLES[kind] + (", by object" if objects else ""),
        name=f"curve-{kind}" + ("-objects" if objects else ""),
        columns=[*columns, *FRACTION_COLUMNS, *MEAN_COLUMNS],
        rows=[row for _, _, row in rows],
        best="column" if methods else "",
        note="Fractions are of all initial poses of a level, a missing estimate failing; errors are over those found. "
        "Diverged: rotation error over 45° or translation error over half a diameter.",
    )


def _cell(point: Point, name: str) -> Cell:
    value: float = point[name]
    ends = point.get("intervals", {}).get(name)
    return value if ends is None else Interval(value=value, low=ends[0], high=ends[1])


def _digits(levels: Sequence[float]) -> int:
    """Decimals that show every level as it is, three at most."""
    return next((digits for digits in range(3) if all(round(level, digits) == level for level in levels)), 3)
