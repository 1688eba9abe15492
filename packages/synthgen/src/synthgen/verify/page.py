"""Verification report as a self-contained HTML page, readable from 360 px width on."""

import base64
from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

import cv2
import numpy as np
from posecore.errors import ShardError, StorageError
from posecore.html import definitions, document
from posecore.shard import ShardReader

from synthgen.inspect.preview import Image, sample_row, title_row
from synthgen.verify import plots
from synthgen.verify.coverage import by_scene, view_counts
from synthgen.verify.findings import Finding, VerificationReport

SHOWN = 6  # samples of each contact sheet
_PER_CELL = 8  # scenes a cell of the sphere for a uniform distribution of views

STYLE = """
:root { color-scheme: light; --ink: #1c2330; --soft: #5b6472; --line: #dfe3ea; --wash: #f5f7fa; }
* { box-sizing: border-box; }
body { margin: 0 auto; padding: 20px 16px 60px; max-width: 1240px; color: var(--ink); background: #fff;
  font: 15px/1.5 system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", Arial, sans-serif; }
h1 { font-size: 1.6rem; line-height: 1.2; margin: 0 0 4px; overflow-wrap: anywhere; }
h2 { font-size: 1.15rem; margin: 34px 0 8px; padding-top: 14px; border-top: 1px solid var(--line); }
p { margin: 6px 0; max-width: 92ch; overflow-wrap: anywhere; }
.soft { color: var(--soft); }
.verdict { border-left: 4px solid #0b7a55; background: #eef8f3; padding: 10px 14px; margin: 12px 0; }
.verdict.bad { border-color: #b3261e; background: #fdf0ef; }
.bad b, td.bad { color: #b3261e; font-weight: 600; }
td.good { color: #0b6b4b; font-weight: 600; }
.scroll { overflow-x: auto; border: 1px solid var(--line); border-radius: 6px; margin: 8px 0 14px; }
table { border-collapse: collapse; font-size: 13px; font-variant-numeric: tabular-nums; width: 100%; }
th, td { padding: 5px 9px; text-align: left; vertical-align: top; border-bottom: 1px solid var(--line); }
th { white-space: nowrap; } thead th { background: var(--wash); }
td.number { text-align: right; white-space: nowrap; }
td.words { min-width: 26ch; }
tbody tr:last-child > * { border-bottom: 0; }
.plots { display: grid; gap: 16px; grid-template-columns: repeat(auto-fill, minmax(min(100%, 340px), 1fr)); }
figure { margin: 0; min-width: 0; }
figcaption { font-weight: 600; font-size: 13.5px; margin-bottom: 4px; }
figure svg { width: 100%; height: auto; display: block; border: 1px solid var(--line); border-radius: 6px; }
figure p { font-size: 13px; }
svg text { font: 12px system-ui, Arial, sans-serif; fill: #4a5261; }
.grid { stroke: #e8ebf0; fill: none; } .axis { stroke: #9aa3b2; fill: none; }
.cells path { stroke: #fff; stroke-width: 0.7; }
.ring { fill: none; stroke: #5b6472; stroke-width: 1.5; }
.chip { display: inline-block; width: 14px; height: 14px; border-radius: 3px; vertical-align: -2px; }
.sheet img { min-width: 900px; width: 100%; height: auto; display: block; }
dl { display: grid; grid-template-columns: minmax(110px, max-content) 1fr; gap: 3px 14px; font-size: 13.5px; }
dt { font-weight: 600; } dd { margin: 0; overflow-wrap: anywhere; }
@media (max-width: 560px) { body { padding: 14px 10px 40px; font-size: 14px; } th, td { padding: 4px 6px; }
  svg text { font-size: 14px; } dl { grid-template-columns: 1fr; } dd { margin-bottom: 6px; } }
"""


def report_page(report: VerificationReport) -> str:
    """The HTML document."""
    title = f"Verification of {report.url}"
    body = [
        f"<header><h1>{escape(title)}</h1>{_verdict(report)}</header><main>",
        _section("Checks", _checks_table(report.findings), _checks_notes(report)),
        _section("Coverage", _coverage(report)),
        _section("Failed samples", _sheet(report, report.failed_samples()[:SHOWN], "Failed samples")),
        _section("Random samples", _sheet(report, _random_samples(report), "Random samples")),
        _section("Data card", _card(report)),
        "</main>",
    ]
    return document(title, STYLE, "".join(body))


def _section(heading: str, *parts: str) -> str:
    content = "".join(parts)
    return f"<section><h2>{escape(heading)}</h2>{content}</section>" if content else ""


def _verdict(report: VerificationReport) -> str:
    failed, extent = report.failed, f"{report.committed} of {report.card['n']} samples are committed. "
    if failed:
        return f'<p class="verdict bad"><b>{len(failed)} checks fail</b>: {escape(", ".join(failed))}. {extent}</p>'
    return f'<p class="verdict"><b>Every check passes.</b> {extent}</p>'


def _checks_table(findings: Sequence[Finding]) -> str:
    rows = []
    for f in findings:
        mark = '<td class="good">ok</td>' if f.ok else f'<td class="bad">{f.failed} fail</td>'
        worst = "" if f.worst is None else f"{f.worst:.3g}"
        first = "" if f.ok else f" <b>Not in {', '.join(map(str, f.first))}.</b> {escape(f.note)}"
        rows.append(
            f'<tr><th scope="row">{escape(f.name)}</th>{mark}<td class="words">{escape(f.what)}{first}</td>'
            f'<td class="number">{f.covered} {f.items}</td><td class="number">{worst}</td>'
            f'<td>{escape(f.tolerance)}</td><td class="words soft">{escape(f.why)}</td></tr>'
        )
    heads = ("check", "result", "checked property", "items", "worst", "tolerance", "reason")
    head = "".join(f'<th scope="col">{name}</th>' for name in heads)
    return (
        '<div class="scroll" tabindex="0" role="region" aria-label="Checks"><table><thead><tr>'
        f"{head}</tr></thead><tbody>{''.join(rows)}</tbody></table></div>"
    )


def _checks_notes(report: VerificationReport) -> str:
    if not report.rerendered:
        return '<p class="soft">No sample was re-rendered (--samples 0).</p>'
    return (
        f'<p class="soft">Every committed sample was read. {report.rerendered} of {report.committed}, chosen at '
        f"random, were also re-rendered with {escape(report.gl or 'no GL')}.</p>"
    )


def _coverage(report: VerificationReport) -> str:
    coverage = report.coverage
    if not coverage:
        return ""
    scenes = by_scene(coverage)
    rings = int(np.clip(np.sqrt(len(scenes["scene"]) / (6 * _PER_CELL)), 1, 12))
    ranges = _ranges(report)
    by_diameter = "distance_diameters" in ranges
    distance = "distance_diameters" if by_diameter else "distance_m"
    counts = {str(i): int((coverage["obj_id"] == i).sum()) for i in sorted(report.facts.meshes)}
    figures = [
        plots.sphere_maps(*view_counts(scenes["view"], rings), rings),
        plots.position_map(coverage["u"], coverage["v"], report.facts.camera.width_px, report.facts.camera.height_px),
        plots.histogram("In-plane rotation, by scene", "degrees", scenes["roll_deg"], -180, 180),
        plots.histogram(
            "Distance, by scene",
            "diameters" if by_diameter else "metres",
            scenes[distance],
            *ranges[distance],
        ),
        plots.histogram("Perturbation, angle", "degrees", coverage["angle_deg"], *ranges["angle_deg"]),
        plots.histogram(
            "Perturbation, translation",
            "diameters",
            coverage["translation_diameters"],
            *ranges["translation_diameters"],
        ),
        plots.histogram("Visible fraction", "fraction of the silhouette", coverage["visible_fraction"], 0, 1),
        plots.bars("Samples by object", "object id", counts),
        _rejected(coverage["rejected"]),
    ]
    return f'<div class="plots">{"".join(figures)}</div>'


def _ranges(report: VerificationReport) -> dict[str, tuple[float, float]]:
    """Axis limits of the histograms by name: the recipe's bounds, or the data's for pairs cut from images."""
    if not report.facts.rendered:
        names = ("distance_m", "angle_deg", "translation_diameters")
        return {name: (0.0, max(1e-3, 1.0001 * float(report.coverage[name].max()))) for name in names}
    distance, perturbation = (report.card["config"][key] for key in ("distance", "perturbation"))
    name = "distance_diameters" if distance["unit"] == "diameter" else "distance_m"
    return {
        name: (distance["min"], distance["max"]),
        "angle_deg": (0.0, perturbation["max_angle_deg"] * 1.0001),
        "translation_diameters": (0.0, perturbation["max_translation_diameter"] * 1.0001),
    }


def _rejected(draws: np.ndarray) -> str:
    title, label = "Rejected draws before a sample", "draws"
    if int(draws.max()) < 24:
        return plots.bars(title, label, {str(i): int((draws == i).sum()) for i in range(int(draws.max()) + 1)})
    return plots.histogram(title, label, draws.astype(np.float64), 0, float(draws.max()))


def _random_samples(report: VerificationReport) -> list[int]:
    shard_ids = ShardReader(report.url).committed
    size, n = int(report.card["shard_size"]), int(report.card["n"])
    rng = np.random.default_rng(0)
    return sorted({min(int(rng.choice(shard_ids)) * size + int(rng.integers(size)), n - 1) for _ in range(SHOWN)})


def _sheet(report: VerificationReport, indices: Sequence[int], alt: str) -> str:
    reader = ShardReader(report.url)
    rows: list[Image] = []
    for index in indices:
        shard_id, row = divmod(index, reader.shard_size)
        try:
            values = reader.read(shard_id)
        except (ShardError, StorageError):  # a damaged shard, which the check of checksums reports
            continue
        sample = {name: value[row] for name, value in values.items()}
        rows.append(sample_row(sample, index, report.facts.meshes))
    if not rows:
        return ""
    ok, data = cv2.imencode(".jpg", np.concatenate([title_row(), *rows])[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 82])
    assert ok
    text = base64.b64encode(data.tobytes()).decode()
    return (
        f'<div class="scroll sheet" tabindex="0" role="region" aria-label="{alt}">'
        f'<img alt="{alt}: {", ".join(map(str, indices))}" src="data:image/jpeg;base64,{text}"></div>'
    )


def _card(report: VerificationReport) -> str:
    card = report.card
    camera = card["camera"]
    entries = {
        "digest": report.digest,
        "schema": f"{card['schema']} {card['schema_version']}",
        "seed": str(card["seed"]),
        **_origin(report),
        "camera": f"{camera['width_px']} x {camera['height_px']} px, fx {camera['fx']:g}, fy {camera['fy']:g}",
        "patch": f"{card['patch_px']} px, {card['contour_points']} contour points",
        "objects": "; ".join(_object_text(i, entry) for i, entry in card["objects"].items()),
        "versions": ", ".join(f"{name} {version}" for name, version in card.get("versions", {}).items()),
    }
    return definitions(entries)


def _origin(report: VerificationReport) -> dict[str, str]:
    """Entry of the engines, or of the images that pairs were cut from."""
    card = report.card
    if report.facts.rendered:
        return {"engine": f"{card['config']['engine']}, hypotheses {card['config']['hypothesis_engine']}"}
    source = card["source"]
    return {"images": f"{source['images']} of {source['dataset']}, split {source['split']}"}


def _object_text(obj_id: str, entry: Mapping[str, Any]) -> str:
    return f"{obj_id} {entry['name']}, diameter {1e3 * entry['diameter_m']:.4g} mm"
