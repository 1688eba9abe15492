"""What search does not find in an image it looks for again, behind what it has found there."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from posecore import se3
from posecore.raster import Rasteriser
from refinenet.baselines import global_search as search_module
from refinenet.baselines.base import failed
from refinenet.baselines.global_search import GradientSearch, response_maps, similarity_at
from refinenet.baselines.patch import TrackedObject, render_and_crop
from refinenet.baselines.viewpoint_model import make_viewpoint_model
from refinenet.refiner import Frame, Refinement, Request, Status

from ..conftest import K
from .test_baselines import distances, rendered_frame
from .test_global_search import Given, Mover, far_start


@pytest.fixture(scope="module")
def covered(tug, mesh):
    """Frames in which another object hides a third to two thirds of the tug: that object's mesh, and for each frame the
    image, both poses, and the camera z of the other."""
    frames = []
    with Rasteriser({1: tug, 2: mesh}) as rasteriser:
        for seed, aside in ((1, -0.25), (3, 0.25)):
            frame, truth = rendered_frame(tug, rasteriser, seed)
            centre_m = truth[:3, :3] @ tug.center_m + truth[:3, 3]
            R = se3.random_rotation(np.random.default_rng(seed))
            front = se3.make_T(R, 0.8 * centre_m + np.array([aside * tug.diameter_m, 0.0, 0.0]))
            layers = rasteriser.render(2, K, front[None], frame.image.shape[1], frame.image.shape[0])
            soft = cv2.GaussianBlur(layers.mask[0].astype(np.float32), (0, 0), 0.7)[..., None]
            image = (layers.rgb[0] * soft + frame.image * (1 - soft)).astype(np.uint8)
            frames.append((replace(frame, image=image), truth, front, layers.depth_m[0]))
    return mesh, frames


@pytest.mark.slow
def test_what_is_known_to_be_in_front_does_not_count(tug, covered):
    _, frames = covered
    with Rasteriser({1: tug}) as rasteriser:
        target = TrackedObject(obj_id=1, mesh=tug, rasteriser=rasteriser)
        model = make_viewpoint_model(1, tug, rasteriser)
        for frame, truth, _, known_m in frames:
            known = replace(target, known_depth_m=known_m)
            assert similarity_at(frame, truth, known) > 1.4 * similarity_at(frame, truth, target)
            plain, aware = (render_and_crop(frame.image, frame.K, truth, one, 96) for one in (target, known))
            assert plain.visible.all()
            hidden = plain.mask & ~aware.visible
            assert 0.2 < hidden.sum() / plain.mask.sum() < 0.7
            responses = response_maps(plain, 1)
            alone, behind = (
                model.similarity(truth[None], view.K, view.occluder_depth_m, responses)[0] for view in (plain, aware)
            )
            assert behind > 1.2 * alone
            behind_all = replace(
                target, known_depth_m=np.where(known_m > 0, 2 * truth[2, 3], 0.0)
            )  # what lies behind it hides nothing
            assert render_and_crop(frame.image, frame.K, truth, behind_all, 96).visible.all()
            wall = replace(target, known_depth_m=np.full_like(known_m, 0.1))
            assert render_and_crop(frame.image, frame.K, truth, wall, 96) is None


class Knowing(Given):
    """Stands for a network that leaves poses as they are, and tells how close they are to the truth."""

    predicts_pose_quality = True

    def __init__(self, truths):
        super().__init__()
        self.truths = truths

    def refine_batch(self, frame, requests):
        mesh_and_truth = [self.truths[request.obj_id] for request in requests]
        return [
            Refinement(
                T_cam_obj=r.T_cam_obj, status=Status.STOPPED, iterations=1,
                confidence=float(np.exp(-distances(mesh, truth, r.T_cam_obj) / 0.06)),
            )
            for r, (mesh, truth) in zip(requests, mesh_and_truth, strict=True)
        ]  # fmt: skip


@pytest.mark.slow
def test_what_fails_alone_is_found_behind_what_was_found(tug, covered):
    thing, frames = covered
    for frame, truth, front, _ in frames:
        start = Request(obj_id=1, T_cam_obj=far_start(truth, 1))
        rng = np.random.default_rng(0)
        near = Request(obj_id=2, T_cam_obj=se3.perturb(front, np.deg2rad(6), 0.05 * thing.diameter_m, rng))
        knowing = Knowing({1: (tug, truth), 2: (thing, front)})
        refiner = GradientSearch({1: tug, 2: thing}, iterations=2, network=knowing)
        (alone,) = refiner.refine_batch(frame, [start])
        behind, before = refiner.refine_batch(frame, [start, near])
        refiner.close()
        assert alone.failed
        assert not before.failed
        assert distances(tug, truth, behind.T_cam_obj) < 0.02
        assert behind.confidence > 0.5
        assert behind.iterations > alone.iterations
        assert len(behind.candidates) > len(alone.candidates)
        refiner = GradientSearch({1: tug, 2: thing}, iterations=2)  # gradients alone do not look again
        unjudged, _ = refiner.refine_batch(frame, [start, near])
        refiner.close()
        assert unjudged.failed


@pytest.mark.slow
def test_what_stays_failed_says_how_far_it_came(tug, covered):
    """Beside the other object, which is found, there is nothing but noise."""
    thing, ((frame, truth, front, known_m), *_) = covered
    noise = np.random.default_rng(0).integers(0, 256, (15, 20, 3), dtype=np.uint8)
    noise = cv2.resize(noise, frame.image.shape[1::-1], interpolation=cv2.INTER_CUBIC)
    frame = replace(frame, image=np.where(known_m[..., None] > 0, frame.image, noise))
    refiner = GradientSearch({1: tug, 2: thing}, iterations=2, network=Knowing({1: (tug, truth), 2: (thing, front)}))
    requests = [Request(obj_id=1, T_cam_obj=far_start(truth, 1)), Request(obj_id=2, T_cam_obj=front)]
    missing, found = refiner.refine_batch(frame, requests)
    (alone,) = refiner.refine_batch(frame, requests[:1])
    refiner.close()
    assert missing.failed
    assert not found.failed
    np.testing.assert_array_equal(missing.T_cam_obj, requests[0].T_cam_obj)
    assert len(missing.candidates) > len(alone.candidates)
    assert f" {missing.candidates[-1].confidence:.3f} at most" in missing.failure
    assert missing.candidates[-1].confidence >= alone.candidates[-1].confidence


def test_poses_are_found_one_behind_the_other(tug, monkeypatch):
    """Each of three only when those before are known; a fourth never."""
    T = [se3.make_T(np.eye(3), np.array([0.1 * i, 0.0, 0.8 + 0.3 * i])) for i in range(4)]
    asked = []

    def refine(self, frame, T_cam_obj, target):
        place, known = (
            round(10 * T_cam_obj[0, 3]),
            0 if target.known_depth_m is None else int(target.known_depth_m[0, 0]),
        )
        asked.append((place, known))
        if place < 3 and known >= place:
            return Refinement(T_cam_obj=T_cam_obj, status=Status.STOPPED, iterations=1, confidence=0.9)
        return failed(T_cam_obj, 1, "no")

    monkeypatch.setattr(search_module.GradientSearch, "_refine", refine)
    monkeypatch.setattr(
        search_module.GradientSearch,
        "_known_depth_m",
        lambda self, frame, request, found: np.full((1, 1), float(len(found))),
    )
    refiner = GradientSearch({1: tug}, iterations=2, network=Mover(None))
    frame = Frame(image=np.zeros((480, 640, 3), np.uint8), K=K)
    results = refiner.refine_batch(frame, [Request(obj_id=1, T_cam_obj=pose) for pose in T])
    refiner.close()
    assert [result.failed for result in results] == [False, False, False, True]
    assert asked == [(0, 0), (1, 0), (2, 0), (3, 0), (1, 1), (2, 1), (3, 1), (2, 2), (3, 2), (3, 3)]
    assert [result.iterations for result in results] == [1, 2, 3, 4]


@pytest.mark.slow
def test_a_pose_of_the_same_object_from_another_start_hides_nothing(tug, covered):
    thing, ((frame, truth, _, _), *_) = covered
    nearer, aside = truth.copy(), truth.copy()
    nearer[:3, 3] *= 0.9
    aside[0, 3] += 0.7 * tug.diameter_m
    refiner = GradientSearch({1: tug, 2: thing}, iterations=1)
    refiner.refine_batch(frame, [Request(obj_id=i, T_cam_obj=truth) for i in (1, 2)])  # so that it can draw both

    def hides(obj_id, pose):
        found = [Request(obj_id=obj_id, T_cam_obj=pose)]
        return bool((refiner._known_depth_m(frame, Request(obj_id=1, T_cam_obj=truth), found) > 0).any())

    assert (hides(1, nearer), hides(1, aside), hides(2, nearer)) == (False, True, True)
    refiner.close()
