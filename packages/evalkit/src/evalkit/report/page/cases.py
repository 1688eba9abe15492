"""Pictures of single poses, and lists of missing poses."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from evalkit.evaluation.evaluator import Evaluator
from evalkit.evaluation.scored_file import CaseKey, Scored
from evalkit.report import html, pictures
from evalkit.report.html import Picture
from evalkit.report.summary import ranked_cases

MISSING_LISTED = 20
SHOWN_FIRST = 3
"""Typical and worst cases at the page's top."""
PICTURES_BYTES = 20_000_000
"""Limit for the pictures of a list of cases, so that the page opens quickly."""


def first(evaluator: Evaluator, scored: Sequence[Scored], count: int) -> list[str]:
    """Typical cases, whose VSS in the last result file is next to its median, and the worst ones; each in every file.

    Args:
        evaluator: of the files.
        scored: result files.
        count: worst cases shown on the whole page; 0 shows no case.
    """
    if not count or not scored:
        return []
    ranked = ranked_cases(scored)
    worst = ranked[: min(count, SHOWN_FIRST)]
    others = ranked[len(worst) :]
    begin = min(max(len(ranked) // 2 - SHOWN_FIRST // 2 - len(worst), 0), max(len(others) - SHOWN_FIRST, 0))
    typical = others[begin : begin + SHOWN_FIRST]
    name = scored[-1].file.name
    shown = [
        *_shown(evaluator, scored, typical, f"Typical: VSS next to the median of {name}"),
        *_shown(evaluator, scored, worst, f"Worst: lowest VSS in {name}"),
    ]
    if not shown:
        return [html.paragraph("No pictures: the dataset has no images of these poses.", soft=True)] if ranked else []
    return [legend(), *shown]


def further_worst(evaluator: Evaluator, scored: Sequence[Scored], count: int) -> list[str]:
    """The worst cases that follow those of `first`, up to `count` in total."""
    keys = ranked_cases(scored)[SHOWN_FIRST:count]
    return [legend(), *shown] if (shown := _shown(evaluator, scored, keys, "")) else []


def _shown(evaluator: Evaluator, scored: Sequence[Scored], keys: Sequence[CaseKey], title: str) -> list[str]:
    """Cases with images, in a grid; empty without any."""
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
        return []
    left = len(keys) - len(articles)
    note = [html.paragraph(f"{left} more have no image or no room here.", soft=True)] if left else []
    heading = [html.heading(title)] if title else []
    return [*heading, *note, html.cases(articles, len(scored))]


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
