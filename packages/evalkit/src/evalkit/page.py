"""A report's sections from scores and pictures: words, tables, plots, worst cases, definitions, inputs."""

from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

import numpy as np
import pandas as pd

from evalkit import html, pictures, plots
from evalkit.evaluate import Evaluator
from evalkit.html import Shot
from evalkit.plots import Series
from evalkit.scored import CaseKey, Scored
from evalkit.summary import visibility_bins, worst_cases
from evalkit.table import column

VISIBILITY_EDGES = tuple(float(edge) for edge in np.linspace(0.0, 1.0, 11))
MISSING_LISTED = 20


def report_page(evaluator: Evaluator, scored: Sequence[Scored], summary: Mapping[str, Any], worst: int) -> str:
    """The HTML document."""
    dataset = summary["dataset"]
    title = f"Pose report: {dataset['name']}"
    names = [item.file.name for item in scored]
    dashed = [item.file.is_start for item in scored]
    colours = plots.series_colours(dashed)
    key = plots.legend(names, colours, dashed)
    head = (
        f"<header><h1>{escape(title)}</h1>"
        + html.paragraph(
            f"Split {dataset['split']}, {dataset['targets']} targets. VSS is {summary['definitions']['VSS variant']}.",
            soft=True,
        )
        + "</header>"
    )
    words = "".join(html.paragraph(item["words"]) for item in summary["against_start"])
    body = [
        head,
        f'<div class="words">{words}</div>' if words else "",
        html.section("Totals", _totals(summary), _ignored(summary)),
        html.section("Distributions", key, _distribution_plots(scored, colours)),
        html.section("From perturbed starts", key, _level_plots(summary, colours), _level_tables(summary))
        if any(file["by_level"] for file in summary["files"])
        else "",
        html.section("By object", _object_tables(summary)),
        html.section("Worst cases", _worst(evaluator, scored, worst)),
        html.section("Missing estimates", _missing(scored)),
        html.section("Definitions", html.definitions(summary["definitions"])),
        html.section("Inputs and versions", html.definitions(_inputs(summary))),
    ]
    return html.page(title, "".join(body))


def _totals(summary: Mapping[str, Any]) -> str:
    rows = [(file["name"], file["total"]) for file in summary["files"]]
    return _score_tables("result file", rows)


def _score_tables(first: str, rows: Sequence[tuple[str, Mapping[str, Any]]], *, total_last: bool = False) -> str:
    scores = html.table(first, rows, html.SCORE_COLUMNS, total_last=total_last)
    errors = html.table(first, rows, html.ERROR_COLUMNS, total_last=total_last)
    note = html.paragraph("Errors of the estimates that were found:", soft=True)
    return scores + note + errors


def _ignored(summary: Mapping[str, Any]) -> str:
    said = [
        f"{file['name']}: {file['ignored_lines']} lines belong to no target or are outscored, and were left out."
        for file in summary["files"]
        if file["ignored_lines"]
    ]
    return "".join(html.paragraph(text, soft=True) for text in said)


def _object_tables(summary: Mapping[str, Any]) -> str:
    parts = []
    for file in summary["files"]:
        rows = [(f"object {obj_id}", values) for obj_id, values in file["by_object"].items()]
        parts.append(f"<h3>{escape(file['name'])}</h3>")
        parts.append(_score_tables("object", [*rows, ("total", file["total"])], total_last=True))
    return "".join(parts)


def _distribution_plots(scored: Sequence[Scored], colours: Sequence[str]) -> str:
    def figure(title: str, x_label: str, value_of: Any, limit: float) -> str:
        series = []
        for item, colour in zip(scored, colours, strict=True):
            x, y = plots.cumulative(value_of(item.table), limit)
            series.append(Series(name=item.file.name, colour=colour, x=x, y=y, dashed=item.file.is_start))
        return plots.line_plot(title, x_label, "share of poses", series, share=True)

    figures = [
        figure("Rotation error at most", "degrees", lambda table: np.rad2deg(column(table, "re_sym_rad")), 45.0),
        figure("ADD at most", "diameters", lambda table: column(table, "add_m") / column(table, "diameter_m"), 0.5),
        figure("Silhouette mismatch (1 - VSS) at most", "1 - VSS", _mismatch, 1.0),
        *[
            figure(f"Error along camera {axis} at most", "mm", lambda table, axis=axis: _axis_mm(table, axis), limit)
            for axis, limit in (("x", 30.0), ("y", 30.0), ("z", 150.0))
        ],
    ]
    bins = [
        Series(
            name=item.file.name,
            colour=colour,
            x=np.array([center for center, _, _ in visible]),
            y=np.array([vss for _, vss, _ in visible]),
            dashed=item.file.is_start,
            markers=True,
        )
        for item, colour in zip(scored, colours, strict=True)
        if (visible := visibility_bins(item.table, VISIBILITY_EDGES))
    ]
    if bins:
        figures.append(
            plots.line_plot("Mean VSS by visibility", "visible share", "mean VSS", bins, share=False, y_high=1.0)
        )
    return f'<div class="plots">{"".join(figures)}</div>'


def _mismatch(table: pd.DataFrame) -> np.ndarray:
    return np.where(column(table, "found") > 0, 1.0 - column(table, "vss"), np.nan)


def _axis_mm(table: pd.DataFrame, axis: str) -> np.ndarray:
    return np.asarray(np.abs(column(table, f"d{axis}_m")) * 1e3)


LEVEL_PLOTS = (
    ("Rotation error under 5°", "under_5deg", True),
    ("Rotation error under 10°", "under_10deg", True),
    ("Rotation error under 20°", "under_20deg", True),
    ("Translation error under 0.1 diameter", "te_under_0.1d", True),
    ("Diverged", "diverged", True),
    ("Mean final rotation error, deg", "re_sym_deg_mean", False),
    ("Mean final translation error, mm", "te_mm_mean", False),
)
LEVEL_LABELS = {"angle": "start rotated by, degrees", "translation": "start moved by, diameters"}


def _level_plots(summary: Mapping[str, Any], colours: Sequence[str]) -> str:
    parts = []
    for kind, label in LEVEL_LABELS.items():
        drawn = [
            (file, colour) for file, colour in zip(summary["files"], colours, strict=True) if kind in file["by_level"]
        ]
        if not drawn:
            continue
        figures = [
            plots.line_plot(
                title,
                label,
                "share of poses" if share else title.rsplit(", ", 1)[-1],
                [
                    Series(
                        name=file["name"],
                        colour=colour,
                        x=_values(file["by_level"][kind], "level"),
                        y=_values(file["by_level"][kind], key),
                        dashed=file["is_start"],
                        markers=True,
                    )
                    for file, colour in drawn
                ],
                share=share,
            )
            for title, key, share in LEVEL_PLOTS
        ]
        parts.append(f'<h3>{escape(label.capitalize())}</h3><div class="plots">{"".join(figures)}</div>')
    return "".join(parts)


def _values(points: Sequence[Mapping[str, Any]], key: str) -> np.ndarray:
    return np.array([np.nan if point[key] is None else point[key] for point in points], dtype=np.float64)


def _level_tables(summary: Mapping[str, Any]) -> str:
    parts = []
    for file in summary["files"]:
        for kind, unit in (("angle", "°"), ("translation", " d")):
            if kind in file["by_level"]:
                rows = [(f"{point['level']:g}{unit}", point) for point in file["by_level"][kind]]
                parts.append(f"<h3>{escape(file['name'])}, by start {kind}</h3>")
                parts.append(html.table("start", rows, html.LEVEL_COLUMNS))
    return "".join(parts)


def _worst(evaluator: Evaluator, scored: Sequence[Scored], count: int) -> str:
    keys = worst_cases(scored, count)
    index_of = [item.cases() for item in scored]
    articles = [article for key in keys if (article := _case(evaluator, scored, index_of, key))]
    if not articles:
        return ""
    green, pink = ("#{:02x}{:02x}{:02x}".format(*colour) for colour in (pictures.TRUTH_RGB, pictures.ESTIMATE_RGB))
    note = (
        f"<p>Lowest VSS in {escape(scored[-1].file.name)}, lowest first. "
        f'<span class="swatch" style="background:{green}"></span> ground truth, '
        f'<span class="swatch" style="background:{pink}"></span> estimate; occluders are not cut out.</p>'
    )
    return note + html.cases(articles, len(scored))


def _case(
    evaluator: Evaluator, scored: Sequence[Scored], index_of: Sequence[Mapping[CaseKey, int]], key: CaseKey
) -> str:
    scene_id, im_id = key[0], key[1]
    rgb = pictures.read_image(evaluator, scene_id, im_id)
    if rgb is None:
        return ""
    present = [(item, lookup[key]) for item, lookup in zip(scored, index_of, strict=True) if key in lookup]
    first, place = present[0]
    row, T_gt = first.table.iloc[place], first.T_gt[place]
    obj_id = int(row.obj_id)
    poses = [item.T_est[index] if item.table.found.iloc[index] else None for item, index in present]
    camera = evaluator.camera(scene_id, im_id)
    window = pictures.common_window(evaluator, obj_id, camera, T_gt, [T_est for T_est in poses if T_est is not None])
    shots = []
    for (item, index), T_est in zip(present, poses, strict=True):
        image = pictures.overlay(evaluator, rgb, camera, window, obj_id, T_gt, T_est)
        caption = _caption(item.table.iloc[index])
        shots.append(Shot(name=item.file.name, url=pictures.data_url(image), caption=caption))
    visible = "" if np.isnan(row.visib_fract) else f", {100 * row.visib_fract:.0f}% visible"
    level = ""
    if np.isfinite(row.start_angle_deg):
        level = f", start {row.start_angle_deg:g}° and {row.start_translation_diameter:g} d off"
    return html.case(f"Scene {scene_id}, image {im_id}, object {obj_id}{visible}{level}", shots)


def _caption(row: Any) -> str:
    if not row.found:
        return "missing"
    moved = ", ".join(f"{axis}\N{NO-BREAK SPACE}{1e3 * row[f'd{axis}_m']:+.1f}" for axis in "xyz")
    return f"VSS {row.vss:.3f}, {np.rad2deg(row.re_sym_rad):.1f}°, {moved} mm"


def _missing(scored: Sequence[Scored]) -> str:
    parts = []
    for item in scored:
        rows = item.table[~item.table.found]
        if len(rows):
            listed = rows[["scene_id", "im_id", "obj_id"]].head(MISSING_LISTED)
            named = ", ".join("/".join(map(str, ids)) for ids in listed.to_numpy().tolist())
            more = f" and {len(rows) - MISSING_LISTED} more" if len(rows) > MISSING_LISTED else ""
            parts.append(html.paragraph(f"{item.file.name}: {len(rows)} (scene/image/object) {named}{more}."))
    return "".join(parts)


def _inputs(summary: Mapping[str, Any]) -> dict[str, str]:
    dataset = summary["dataset"]
    entries = {f"dataset {dataset['name']}": f"{dataset['path']}, split {dataset['split']}, sha256 {dataset['sha256']}"}
    for file in summary["files"]:
        said = "; ".join(f"{key} {value}" for key, value in file["sidecar"].items() if key != "dataset")
        entries[file["name"]] = f"{file['path']}, sha256 {file['sha256']}" + (f"; {said}" if said else "")
    entries["versions"] = ", ".join(f"{name} {version}" for name, version in summary["versions"].items())
    return entries
