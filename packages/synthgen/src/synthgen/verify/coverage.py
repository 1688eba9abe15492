"""Distribution of a dataset's samples: the numbers behind the histograms."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from synthgen.verify.facts import Facts, SampleBatch
from synthgen.verify.pose_checks import centres_cam_m, perturbation_deg, translation_diameters

Coverage = Mapping[str, np.ndarray]
"""Numbers by name, one row a sample."""


def measure_coverage(batch: SampleBatch) -> dict[str, np.ndarray]:
    """Coverage numbers of each sample.

    Returns:
        view: (n, 3) unit vector from the object's box centre to the camera, object frame.
        roll_deg: In-plane rotation of the object's z axis (of its x axis where the view is along z).
        distance_m: Camera z of the box centre.
        distance_diameters: The same in diameters.
        angle_deg, translation_diameters: Distance between ground truth and hypothesis.
        visible_fraction: As stored.
        u, v: Window centre as a fraction of the image.
        scene, obj_id, rejected: As stored.
    """
    T, centre = batch["T_cam_obj"], centres_cam_m(batch, "T_cam_obj")
    R = T[:, :3, :3]
    with np.errstate(invalid="ignore", divide="ignore"):
        view = -np.einsum("nji,nj->ni", R, centre)
        view /= np.linalg.norm(view, axis=1, keepdims=True)
    axis = np.where(np.abs(view[:, 2:]) < 0.99, R[:, :, 2], R[:, :, 0])
    x0, y0, side = batch["window_px"].T
    return {
        "view": view,
        "roll_deg": np.rad2deg(np.arctan2(axis[:, 0], -axis[:, 1])),
        "distance_m": centre[:, 2],
        "distance_diameters": centre[:, 2] / batch.facts.object_values(batch["obj_id"], "diameter_m"),
        "angle_deg": perturbation_deg(batch),
        "translation_diameters": translation_diameters(batch),
        "visible_fraction": batch["visible_fraction"].astype(np.float64),
        "u": (x0 + side / 2) / batch.facts.camera.width_px,
        "v": (y0 + side / 2) / batch.facts.camera.height_px,
        "scene": batch["scene_index"].astype(np.int64),
        "obj_id": batch["obj_id"].astype(np.int64),
        "rejected": batch["rejected"].astype(np.int64),
    }


def joined(parts: Sequence[Coverage]) -> dict[str, np.ndarray]:
    """Rows of several shards, concatenated."""
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]} if parts else {}


def by_scene(coverage: Coverage) -> dict[str, np.ndarray]:
    """The first sample of each object in each scene, for numbers of the ground truth."""
    _, first = np.unique(np.stack([coverage["scene"], coverage["obj_id"]]), axis=1, return_index=True)
    return {name: values[first] for name, values in coverage.items()}


def lambert_xy(direction: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 2"]:
    """Lambert's azimuthal equal-area map of unit directions, each hemisphere around its own pole.

    The pole (z = +1 or -1) is at (0, 0), the equator at radius 1; equal areas on the sphere stay equal. Azimuth runs
    counter-clockwise from +x for both hemispheres. Source: Snyder, Map Projections - A Working Manual, 24.
    """
    radius = np.sqrt((1.0 - np.abs(direction[:, 2])).clip(0.0))
    azimuth = np.arctan2(direction[:, 1], direction[:, 0])
    return np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth)], axis=-1)


def sectors_in(ring: Any) -> Any:
    """Number of cells in a ring of the map; with it all cells have equal area and are nearly square."""
    return 3 * (2 * ring + 1)


def view_counts(view: Float[np.ndarray, "n 3"], rings: int) -> tuple[Int[np.ndarray, " c"], Int[np.ndarray, " c"]]:
    """Directions in each cell of the two hemispheres' maps, (upper, lower).

    Ring k lies between the radii k / rings and (k + 1) / rings and is cut into `sectors_in(k)` cells from +x on,
    counter-clockwise. A map has 3 rings^2 cells of equal area, from the pole outwards.
    """
    finite = view[np.isfinite(view).all(axis=1)]
    xy = lambert_xy(finite)
    ring = np.minimum((np.linalg.norm(xy, axis=1) * rings).astype(int), rings - 1)
    azimuth = np.arctan2(xy[:, 1], xy[:, 0]) / (2 * np.pi) % 1.0
    sectors = sectors_in(ring)
    cell = 3 * ring**2 + np.minimum((azimuth * sectors).astype(int), sectors - 1)
    upper = finite[:, 2] >= 0
    return (
        np.bincount(cell[upper], minlength=3 * rings**2),
        np.bincount(cell[~upper], minlength=3 * rings**2),
    )


def summary(coverage: Coverage, facts: Facts) -> dict[str, object]:
    """Coverage in a few numbers, for JSON: quantiles 0, 0.25, 0.5, 0.75, 1, and samples by object."""
    result: dict[str, object] = {}
    for name in (
        "distance_m",
        "distance_diameters",
        "angle_deg",
        "translation_diameters",
        "visible_fraction",
        "rejected",
    ):
        finite = coverage[name][np.isfinite(coverage[name])] if coverage else np.zeros(0)
        result[name] = np.quantile(finite, [0, 0.25, 0.5, 0.75, 1]).tolist() if len(finite) else None
    counts = coverage["obj_id"] if coverage else np.zeros(0, np.int64)
    result["samples_by_object"] = {str(i): int((counts == i).sum()) for i in sorted(facts.meshes)}
    return result
