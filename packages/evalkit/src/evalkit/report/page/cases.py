"""Pictures of single poses, and lists of missing poses."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from evalkit.evaluation.evaluator import Evaluator
from evalkit.evaluation.scored_file import CaseKey, Scored
from evalkit.report import html, pictures
from evalkit.report.html import Picture
from evalkit.report.summary import worst_cases

MISSING_LISTED = 20
PICTURES_BYTES = 20_000_000
"""Limit for a page's pictures, so that the page opens quickly."""


def worst(evaluator: Evaluator, scored: Sequence[Scored], count: int) -> list[str]:
    """The poses with the lowest VSS in the last result file, and the same poses in the other files."""
    keys = worst_cases(scored, count)
    lookups = [item.cases() for item in scored]
    articles: list[str] = []
    size = 0
    for key in keys:
        article = case(evaluator, scored, lookups, key)
        size += len(article)
        if size > PICTURES_BYTES:
            break
        articles += [article] if article else []
    if not articles:
        return [html.paragraph("No pictures: the dataset has no images of these poses.", soft=True)] if keys else []
    shown = f"{len(articles)} poses with the lowest VSS" if len(articles) > 1 else "The pose with the lowest VSS"
    short = "" if len(articles) == len(keys) else f" {len(keys) - len(articles)} more have no image or no room here."
    note = f"{shown} in {scored[-1].file.name}, lowest first.{short}"
    return [html.paragraph(note), legend(), html.cases(articles, len(scored))]


def legend() -> str:
    """Legend of the contours."""
    green, pink = ("#{:02x}{:02x}{:02x}".format(*colour) for colour in (pictures.GT_RGB, pictures.ESTIMATE_RGB))
    entries = "".join(
        f'<li><svg viewBox="0 0 38 14" aria-hidden="true"><path d="M1 7H37" stroke="#141414" stroke-width="6"/>'
        f'<path d="M1 7H37" stroke="{colour}" stroke-width="4"{dash}/></svg>{text}</li>'
        for colour, dash, text in (
            (green, "", "ground truth, whole line"),
            (pink, ' stroke-dasharray="8 5"', "estimate, dashed line; occluders are not cut out"),
        )
    )
    return f'<ul class="legend">{entries}</ul>'


def case(evaluator: Evaluator, scored: Sequence[Scored], lookups: Sequence[Mapping[CaseKey, int]], key: CaseKey) -> str:
    """One pose in every result file that has it; empty where the dataset has no image.

    Args:
        evaluator: of the dataset.
        scored: result files.
        lookups: `Scored.cases()` of each.
        key: of the pose.
    """
    scene_id, im_id = key[0], key[1]
    rgb = pictures.read_image(evaluator, scene_id, im_id)
    present = [(item, lookup[key]) for item, lookup in zip(scored, lookups, strict=True) if key in lookup]
    if rgb is None or not present:
        return ""
    first, first_row = present[0]
    row, T_gt = first.table.iloc[first_row], first.T_gt[first_row]
    obj_id = int(row.obj_id)
    poses = [item.T_est[index] if item.table.found.iloc[index] else None for item, index in present]
    camera = evaluator.camera(scene_id, im_id)
    window = pictures.common_window(evaluator, obj_id, camera, T_gt, [T_est for T_est in poses if T_est is not None])
    shown = []
    for (item, index), T_est in zip(present, poses, strict=True):
        image = pictures.overlay(evaluator, rgb, camera, window, obj_id, T_gt, T_est)
        caption = _caption(item.table.iloc[index])
        shown.append(Picture(name=item.file.name, url=pictures.data_url(image), caption=caption))
    visible = "" if np.isnan(row.visib_fract) else f", {100 * row.visib_fract:.0f}% visible"
    level = ""
    if np.isfinite(row.initial_angle_deg):
        level = f", initial pose {row.initial_angle_deg:g}° and {row.initial_translation_diameter:g} d off"
    return html.case(f"Scene {scene_id}, image {im_id}, object {obj_id}{visible}{level}", shown)


def _caption(row: Any) -> str:
    if not row.found:
        return "missing"
    moved = ", ".join(f"{axis}\N{NO-BREAK SPACE}{1e3 * row[f'd{axis}_m']:+.1f}" for axis in "xyz")
    return f"VSS {row.vss:.3f}, {np.rad2deg(row.re_sym_rad):.1f}°, {moved} mm"


def missing(scored: Sequence[Scored]) -> list[str]:
    """Expected poses without an estimate, for each file."""
    shown = []
    for item in scored:
        rows = item.table[~item.table.found]
        if len(rows):
            listed = rows[["scene_id", "im_id", "obj_id"]].head(MISSING_LISTED)
            named = ", ".join("/".join(map(str, ids)) for ids in listed.to_numpy().tolist())
            more = f" and {len(rows) - MISSING_LISTED} more" if len(rows) > MISSING_LISTED else ""
            shown.append(html.paragraph(f"{item.file.name}: {len(rows)} (scene/image/object) {named}{more}."))
    return shown
