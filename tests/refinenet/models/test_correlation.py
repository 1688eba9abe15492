"""What preset `flow` matches two patches with: gradients of render and scene."""

import numpy as np
import pytest
import torch
from posecore import se3
from posecore.camera import crop_K
from posecore.raster import Rasteriser
from posecore.window import diameter_window
from refinenet.image.edge_gradients import orientation_gradients
from refinenet.models.correlation import GradientCorrelation, directions, orientations

from ..conftest import K

P = 96


def test_gradients_are_those_of_the_similarity():
    """Away from weak edges, whose strength fades: twice the angle of the channel that changes most."""
    rgb = np.random.default_rng(0).integers(0, 256, (2, 32, 32, 3)).astype(np.float32)
    unit, strength = orientation_gradients(rgb)
    planes = torch.from_numpy(rgb).permute(0, 3, 1, 2)
    x, y = unit[..., 0], unit[..., 1]
    weight = strength**2 / (strength**2 + 12.0**2)
    twice = np.stack([(x * x - y * y) * weight, 2 * x * y * weight], 1)
    cells = twice.reshape(2, 2, 16, 2, 16, 2).mean((3, 5))
    np.testing.assert_allclose(orientations(planes, 12.0), cells, atol=1e-4)
    grey = np.repeat(rgb.mean(-1, keepdims=True), 3, -1)
    unit, strength = orientation_gradients(grey)
    cells = (unit * (strength / np.sqrt(strength**2 + 24.0**2))[..., None]).reshape(2, 16, 2, 16, 2, 2).mean((2, 4))
    np.testing.assert_allclose(directions(planes, 24.0), cells.transpose(0, 3, 1, 2), atol=1e-4)


@pytest.mark.parametrize(("right", "down"), [(0, 0), (6, 2), (-4, 8), (10, -10)])
def test_gradients_match_at_the_shift_that_was_made(mesh, right, down):
    """Other colours and another light, a background: of all shifts the true one agrees best, of either kind."""
    truth = se3.make_T(se3.random_rotation(np.random.default_rng(1)), np.array([0.0, 0.0, 6 * mesh.diameter_m]))
    K_crop = crop_K(K, diameter_window(K, truth, mesh.center_m, mesh.diameter_m, 1.3), P)
    with Rasteriser({1: mesh}) as rasteriser:
        layers = rasteriser.render(1, K_crop, truth[None], P, P)
    rgb, mask = layers.rgb[0], layers.mask[0]
    brighter = (40 + 0.5 * rgb[..., ::-1]).astype(np.uint8)
    scene = np.where(mask[..., None], brighter, np.uint8(128))
    scene = np.roll(scene, (down, right), (0, 1))
    correlation = GradientCorrelation(6)
    found = correlation(*(torch.from_numpy(np.ascontiguousarray(x))[None] for x in (
        rgb.transpose(2, 0, 1), mask.astype(np.float32), scene.transpose(2, 0, 1)
    )))  # fmt: skip
    assert found.shape == (1, correlation.channels, P // 4, P // 4)
    orientation, direction = found[0, :-2].reshape(2, 13, 13, P // 4, P // 4)
    amounts = found[0, -2:]
    for volume, amount in ((orientation, amounts[0]), (direction, amounts[1])):
        total = (volume * amount).sum((2, 3))
        best = np.unravel_index(int(total.argmax()), (13, 13))
        assert (best[1] - 6, best[0] - 6) == (right // 2, down // 2)
        assert total.max() > 1.2 * total.flatten().sort().values[-10]
    # cells where no edge of the render is agree with nothing
    empty = amounts[0] == 0
    assert empty.any()
    assert orientation[:, :, empty].abs().max() == 0


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize(("batch", "side_px", "radius"), [(1, 96, 6), (5, 64, 3)])
def test_compiled_loops_give_the_bits_of_torch(batch, side_px, radius, threads, monkeypatch):
    generator, before = torch.Generator().manual_seed(0), torch.get_num_threads()
    scene, render = (
        torch.randint(0, 256, (batch, 3, side_px, side_px), dtype=torch.uint8, generator=generator) for _ in range(2)
    )
    mask = (torch.rand(batch, side_px, side_px, generator=generator) > 0.3).float()
    correlation = GradientCorrelation(radius)
    torch.set_num_threads(threads)
    try:
        compiled = correlation(render, mask, scene)
    finally:
        torch.set_num_threads(before)
    monkeypatch.setattr("refinenet.models.correlation.has_loop", lambda values: False)
    assert torch.equal(compiled, correlation(render, mask, scene))
