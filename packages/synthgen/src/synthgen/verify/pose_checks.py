"""Checks of numbers: poses, camera, object, window, and the recipe's bounds."""

import numpy as np
from jaxtyping import Float
from posecore import se3
from posecore.camera import crop_K
from posecore.window import Window, diameter_window, fixed_window

from synthgen.pairs.pair_maker import MAX_ATTEMPTS, MAX_HYPOTHESIS_ATTEMPTS
from synthgen.verify.check import CheckList
from synthgen.verify.facts import SampleBatch

CHECKS = CheckList()


@CHECKS.register("finite", 0, "values", "NaN and infinity have no meaning in any field")
def finite(batch: SampleBatch) -> Float[np.ndarray, " n"]:
    """No field holds NaN or infinity."""
    bad = np.zeros(len(batch))
    for values in batch.values.values():
        if values.dtype.kind == "f":
            bad += (~np.isfinite(values)).reshape(len(batch), -1).sum(axis=1)
    return bad


@CHECKS.register("poses", 1e-9, "1", "poses are stored in float64 as they were drawn; products of rotations lose 1e-15")
def poses(batch: SampleBatch) -> Float[np.ndarray, " n"]:
    """Both poses are rigid: R R^T = I, det R = +1, last row 0 0 0 1."""
    worst = np.zeros(len(batch))
    for name in ("T_cam_obj", "T_cam_obj_hypothesis"):
        T = batch[name]
        R = T[:, :3, :3]
        with np.errstate(invalid="ignore", over="ignore"):  # NaN stays NaN, which fails
            residual = np.abs(R @ np.swapaxes(R, 1, 2) - np.eye(3)).max(axis=(1, 2))
            residual = np.maximum(residual, np.abs(np.linalg.det(R) - 1.0))
        worst = np.maximum(worst, np.maximum(residual, np.abs(T[:, 3] - np.array([0.0, 0.0, 0.0, 1.0])).max(axis=1)))
    return worst


@CHECKS.register("camera", 1e-6, "px", "float64 throughout; the card holds the intrinsics of the render")
def camera(batch: SampleBatch) -> Float[np.ndarray, " n"]:
    """K is the card's camera where all images share it, and K_crop is K cut to window_px."""
    K, windows = batch["K"], batch["window_px"]
    shared = batch.facts.card["camera"].get("shared", True)
    worst = np.abs(K - batch.facts.camera.K).max(axis=(1, 2)) * shared
    for i in range(len(batch)):
        if windows[i, 2] > 0:
            expected = crop_K(K[i], as_window(windows[i]), batch.facts.patch_px)
            worst[i] = max(worst[i], np.abs(batch["K_crop"][i] - expected).max())
        else:
            worst[i] = np.inf
    return np.asarray(worst)


@CHECKS.register("object", 0, "flag", "an object id is an integer")
def listed_object(batch: SampleBatch) -> Float[np.ndarray, " n"]:
    """obj_id is an object of the data card."""
    return np.array([float(i not in batch.facts.meshes) for i in batch["obj_id"].tolist()])


@CHECKS.register("window", 1e-3, "px", "the box is projected from models/, whose millimetres are float32")
def window(batch: SampleBatch) -> Float[np.ndarray, " n"]:
    """The window has the object's fixed side or follows its distance, and is centred on the hypothesis' box."""
    side_px = batch.facts.object_values(batch["obj_id"], "window_side_px")
    scale = batch.facts.diameter_scale
    error = np.full(len(batch), np.inf)
    for i, obj_id in enumerate(batch["obj_id"].tolist()):
        if obj_id in batch.facts.meshes:
            T = batch["T_cam_obj_hypothesis"][i]
            mesh, K = batch.facts.meshes[obj_id], batch["K"][i]
            expected = (
                fixed_window(batch.facts.hulls_m[obj_id], K, T, side_px[i])
                if scale is None
                else diameter_window(K, T, mesh.center_m, mesh.diameter_m, scale)
            )
            error[i] = np.abs(batch["window_px"][i] - expected.as_array()).max()
    return error


@CHECKS.register(
    "distance", 1e-6, "diameters", "the box centre comes from models/, whose millimetres are float32", rendered=True
)
def distance(batch: SampleBatch) -> Float[np.ndarray, " n"]:
    """Camera z of the box centre at the ground truth lies in the configured range."""
    distance = batch.facts.card["config"]["distance"]
    diameter_m = batch.facts.object_values(batch["obj_id"], "diameter_m")
    scale = diameter_m if distance["unit"] == "diameter" else np.ones(len(batch))
    z = centres_cam_m(batch, "T_cam_obj")[:, 2]
    return np.maximum(distance["min"] * scale - z, z - distance["max"] * scale).clip(0) / diameter_m


@CHECKS.register(
    "angle", 1e-6, "deg", "float64 throughout; the angle of two rotations is exact to 1e-8 rad", rendered=True
)
def angle(batch: SampleBatch) -> Float[np.ndarray, " n"]:
    """Rotation between ground truth and hypothesis is at most perturbation.max_angle_deg."""
    limit = batch.facts.card["config"]["perturbation"]["max_angle_deg"]
    return (perturbation_deg(batch) - limit).clip(0)


@CHECKS.register(
    "translation", 1e-6, "diameters", "the box centre comes from models/, whose millimetres are float32", rendered=True
)
def translation(batch: SampleBatch) -> Float[np.ndarray, " n"]:
    """Box centres at ground truth and hypothesis are at most perturbation.max_translation_diameter apart."""
    limit = batch.facts.card["config"]["perturbation"]["max_translation_diameter"]
    return (translation_diameters(batch) - limit).clip(0)


@CHECKS.register("scene", 0, "flag", "all samples of a scene store the same pose", rendered=True)
def scene(batch: SampleBatch) -> Float[np.ndarray, " n"]:
    """scene_index is the sample's index over the hypotheses per scene; a scene's samples have one object and pose."""
    per_scene = batch.facts.hypotheses_per_scene
    wrong = batch["scene_index"] != batch.indices // per_scene
    first = np.searchsorted(batch.indices, batch.indices - batch.indices % per_scene)
    same = (batch["T_cam_obj"] == batch["T_cam_obj"][first]).all(axis=(1, 2))
    return np.asarray(wrong | ~same | (batch["obj_id"] != batch["obj_id"][first])).astype(np.float64)


@CHECKS.register("rejected", 0, "flag", "more draws than the sampler makes cannot have been rejected")
def rejected(batch: SampleBatch) -> Float[np.ndarray, " n"]:
    """The number of rejected draws is within the sampler's limits."""
    count = batch["rejected"]
    return np.asarray((count < 0) | (count > MAX_ATTEMPTS + MAX_HYPOTHESIS_ATTEMPTS)).astype(np.float64)


def centres_cam_m(batch: SampleBatch, pose: str) -> Float[np.ndarray, "n 3"]:
    """Box centres of the objects in the camera frame at a pose, metres; NaN for objects that are not in the card."""
    T = batch[pose]
    return np.einsum("nij,nj->ni", T[:, :3, :3], batch.facts.centres_m(batch["obj_id"])) + T[:, :3, 3]


def perturbation_deg(batch: SampleBatch) -> Float[np.ndarray, " n"]:
    """Rotation angle between ground truth and hypothesis, degrees."""
    R = batch["T_cam_obj_hypothesis"][:, :3, :3] @ np.swapaxes(batch["T_cam_obj"][:, :3, :3], 1, 2)
    return np.rad2deg(se3.rotation_angle_rad(R))


def translation_diameters(batch: SampleBatch) -> Float[np.ndarray, " n"]:
    """Distance between the box centres at ground truth and hypothesis, diameters."""
    shift_m = centres_cam_m(batch, "T_cam_obj_hypothesis") - centres_cam_m(batch, "T_cam_obj")
    return np.linalg.norm(shift_m, axis=1) / batch.facts.object_values(batch["obj_id"], "diameter_m")


def as_window(values: Float[np.ndarray, "3"]) -> Window:
    """The window of a stored `window_px`: x0, y0 and side, pixels."""
    return Window(x0_px=float(values[0]), y0_px=float(values[1]), side_px=float(values[2]))
