"""Why draws are rejected, and which setting is to blame when all of them are."""

from collections import Counter
from typing import Literal

from posecore.errors import ConfigError

from synthgen.config import SynthConfig

# Of scenes: the object is outside the image, too small, hidden, or has no hypothesis. Of hypotheses: a silhouette
# leaves the window, or is too small.
Reason = Literal["outside", "small", "hidden", "no hypothesis", "left window", "too small"]
Tally = Counter[Reason]

_OF_SCENES: tuple[Reason, ...] = ("outside", "small", "hidden", "no hypothesis")


def nothing_accepted(scene_index: int, name: str, tally: Tally, config: SynthConfig) -> ConfigError:
    """The error for a scene none of whose draws can be used; it names the setting that rejected most of them.

    Args:
        scene_index: Which scene.
        name: The object's name.
        tally: Rejections by reason.
        config: Recipe.
    """
    scenes = {reason: tally[reason] for reason in _OF_SCENES if tally[reason]}
    worst: Reason = max(scenes, key=lambda reason: scenes[reason], default="hidden")
    said = {
        "outside": "the object outside the image",
        "small": "its silhouette too small",
        "hidden": "too much of it hidden",
        "no hypothesis": "no hypothesis that fits",
    }
    counted = ", ".join(f"{count} x {said[reason]}" for reason, count in scenes.items())
    advice = _advice(worst, tally, config)
    return ConfigError(f"scene {scene_index} ({name}): all {sum(scenes.values())} draws rejected ({counted}); {advice}")


def _advice(worst: Reason, tally: Tally, config: SynthConfig) -> str:
    view, window, distance = config.view, config.window, config.distance
    if worst == "outside":
        return (
            f"lower view.position_jitter (is {view.position_jitter:g}) or view.min_inside (is {view.min_inside:g}), "
            f"or raise distance.min (is {distance.min:g} {distance.unit})"
        )
    if worst == "small":
        return (
            f"lower window.min_area_px (is {window.min_area_px}) or distance.max (is {distance.max:g} {distance.unit})"
        )
    if worst == "hidden":
        front = list(config.occluders.front)
        table = (
            "" if config.scene.kind == "cutout" else ", or lower tabletop.distractors or raise tabletop.elevation_deg"
        )
        return (
            f"lower occluders.min_visible (is {config.occluders.min_visible:g}) or occluders.front (is {front}){table}"
        )
    left, small = tally["left window"], tally["too small"]
    reasons = f"of {left + small} hypotheses {left} left the window and {small} were too small"
    if left >= small:
        return (
            f"{reasons}: lower perturbation.max_translation_diameter "
            f"(is {config.perturbation.max_translation_diameter:g}) or raise window.padding (is {window.padding:g})"
        )
    return f"{reasons}: lower window.min_area_px (is {window.min_area_px}) or distance.max (is {distance.max:g})"
