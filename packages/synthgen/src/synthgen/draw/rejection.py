"""Reasons for the rejection of draws, and the error when all draws of a scene are rejected."""

from collections import Counter
from typing import Literal

from posecore.errors import ConfigError

from synthgen.config import SynthConfig

# Scenes are rejected because the object is outside the image, too small, hidden, or has no hypothesis; hypotheses
# because a silhouette leaves the window or is too small.
Reason = Literal["outside", "small", "hidden", "no hypothesis", "left window", "too small"]
Tally = Counter[Reason]

_SCENE_REASONS: tuple[Reason, ...] = ("outside", "small", "hidden", "no hypothesis")


def nothing_accepted(scene_index: int, name: str, tally: Tally, config: SynthConfig) -> ConfigError:
    """The error for a scene without an acceptable draw; it names the setting that rejected most draws.

    Args:
        scene_index: Index of the scene.
        name: The object's name.
        tally: Rejections by reason.
        config: Configuration.
    """
    scenes = {reason: tally[reason] for reason in _SCENE_REASONS if tally[reason]}
    worst: Reason = max(scenes, key=lambda reason: scenes[reason], default="hidden")
    descriptions = {
        "outside": "the object outside the image",
        "small": "its silhouette too small",
        "hidden": "the object too occluded",
        "no hypothesis": "no hypothesis accepted",
    }
    counted = ", ".join(f"{count} x {descriptions[reason]}" for reason, count in scenes.items())
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
