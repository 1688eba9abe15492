"""Correlation (cost volume) of two patches: of learned features, or of gradient orientations without learning."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d, pad

from refinenet.image.edge_gradients import OUTLINE
from refinenet.models.kernels import lightness_gradient, strongest_gradient, window_similarity

HALF_STRENGTH = {"render": 24.0, "scene": 12.0}
"""Gradients of weight one half, in grey levels over two pixels: lens and resampling soften the image's edges."""
MIN_EDGE_FRACTION = 0.02
"""Fraction of edges in a window below which the similarity fades."""


class LocalCorrelation(nn.Module):
    """Correlation of each hypothesis cell with the scene cells around it: (b, c, n, n) twice to (b, k*k, n/2, n/2).

    Dot products of features over `sqrt(c)`, for every second hypothesis cell in both directions, with the scene cells
    up to `radius` away; scene cells outside the patch give 0.

    Source: the correlation layer of FlowNet (Dosovitskiy et al., ICCV 2015).
    """

    def __init__(self, cells: int, radius: int) -> None:
        super().__init__()
        self.radius, self.side = radius, 2 * radius + 1
        row, column = torch.meshgrid(torch.arange(0, cells, 2), torch.arange(0, cells, 2), indexing="ij")
        down, right = torch.meshgrid(torch.arange(self.side), torch.arange(self.side), indexing="ij")
        padded = cells + 2 * radius
        cells_around = (row.flatten()[:, None] + down.flatten()) * padded + column.flatten()[:, None] + right.flatten()
        self.register_buffer("cells_around", cells_around[None], persistent=False)
        self.cells_around: Tensor

    def forward(
        self, hypothesis: Float[Tensor, "b c n n"], scene: Float[Tensor, "b c n n"]
    ) -> Float[Tensor, "b k m m"]:
        """Correlation of both patches' features."""
        b, c, n, _ = hypothesis.shape
        r = self.radius
        queries = hypothesis[:, :, ::2, ::2].permute(0, 2, 3, 1).reshape(b, -1, c)
        keys = pad(scene, (r, r, r, r)).permute(0, 2, 3, 1).reshape(b, -1, c)
        all_pairs = torch.bmm(queries, keys.transpose(1, 2)) * c**-0.5
        near = all_pairs.gather(2, self.cells_around.expand(b, -1, -1))
        return near.reshape(b, n // 2, n // 2, -1).permute(0, 3, 1, 2)


class GradientCorrelation(nn.Module):
    """Similarity of the render's and the scene's gradients around each cell of four pixels, for every small shift.

    Colours and light of a render differ from the image's, but edges have the same positions. So the features are fixed,
    not learned: in windows of twelve pixels, by shifts of two pixels up to `radius`, (a) orientations of the strongest
    gradient of any channel, silhouette included, without sign, and (b) directions of the lightness gradient inside the
    silhouette, with sign. The similarity is relative to the amount of edges in the render's window, which makes the
    last two channels.

    Attributes:
        channels: `2 * (2 * radius + 1)**2 + 2`.

    Source: the orientations of LINE-2D (Hinterstoisser et al., PAMI 2012), as a cost volume.
    """

    def __init__(self, radius: int) -> None:
        super().__init__()
        self.radius, self.side = radius, 2 * radius + 1
        self.channels = 2 * self.side**2 + 2

    @torch.no_grad()
    def forward(
        self,
        hypothesis_rgb: UInt8[Tensor, "b 3 p p"],
        mask: Float[Tensor, "b p p"],
        scene_rgb: UInt8[Tensor, "b 3 p p"],
    ) -> Float[Tensor, "b k m m"]:
        """Similarity of both patches; inputs get no gradient."""
        values, scene = hypothesis_rgb.float(), scene_rgb.float()
        outlined = torch.cat((values, OUTLINE * mask[:, None]), 1)
        inside = avg_pool2d(mask[:, None], 2) > 0.99
        render = torch.cat(
            (orientations(outlined, HALF_STRENGTH["render"]), directions(values, HALF_STRENGTH["render"]) * inside), 1
        )
        image = torch.cat(
            (orientations(scene, HALF_STRENGTH["scene"]), directions(scene, HALF_STRENGTH["scene"])), 1
        )  # fmt: skip
        # torch.linalg.vector_norm takes 100 times as long over channels strided in memory
        amounts = torch.stack([(render[:, i].square() + render[:, i + 1].square()).sqrt() for i in (0, 2)], 1)
        amounts = _around(avg_pool2d(amounts, 2))
        relative = (self._in_a_loop if has_loop(render) else self._relative)(render, image, amounts)
        return torch.cat((relative, amounts), 1)

    def _in_a_loop(
        self, render: Float[Tensor, "b 4 n n"], image: Float[Tensor, "b 4 n n"], amounts: Float[Tensor, "b 2 m m"]
    ) -> Float[Tensor, "b k m m"]:
        """`_relative` in a compiled loop, each thread with a part of the batch."""
        b, r = len(render), self.radius
        result = amounts.new_empty((b, 2 * self.side**2, *amounts.shape[2:]))
        tensors = (render.contiguous(), pad(image, (r, r, r, r)), amounts.contiguous())
        threads = min(torch.get_num_threads(), b)
        parts = [slice(b * i // threads, b * (i + 1) // threads) for i in range(threads)]

        def compute(part: slice) -> None:
            window_similarity(*(x[part].numpy() for x in tensors), np.float32(MIN_EDGE_FRACTION), result[part].numpy())

        if threads == 1:
            compute(parts[0])
        else:
            with ThreadPoolExecutor(threads) as pool:
                list(pool.map(compute, parts))
        return result

    def _relative(
        self, render: Float[Tensor, "b 4 n n"], image: Float[Tensor, "b 4 n n"], amounts: Float[Tensor, "b 2 m m"]
    ) -> Float[Tensor, "b k m m"]:
        similarity = _around(self._similarity(render, image)).unflatten(1, (2, -1))
        return (similarity / (amounts[:, :, None] + MIN_EDGE_FRACTION)).flatten(1, 2)

    def _similarity(
        self, render: Float[Tensor, "b 4 n n"], image: Float[Tensor, "b 4 n n"]
    ) -> Float[Tensor, "b k m m"]:
        """Products for every shift, orientations first, as means of two by two cells; 0 beyond the border."""
        n, r = render.shape[-1], self.radius
        # The batch is the last, contiguous axis: half the time of any other layout.
        render, image = (
            render.permute(1, 2, 3, 0).contiguous(),
            pad(image, (r, r, r, r)).permute(1, 2, 3, 0).contiguous(),
        )
        products = []
        for down in range(self.side):
            # all shifts to the right at once, as a view
            product = image[:, down : down + n].unfold(2, n, 1).permute(0, 1, 2, 4, 3) * render[:, :, None]
            product = product[0::2] + product[1::2]
            product = product[:, 0::2] + product[:, 1::2]
            products.append(product[:, :, :, 0::2] + product[:, :, :, 1::2])
        return torch.stack(products, 1).permute(5, 0, 1, 3, 2, 4).flatten(1, 3) / 4


def has_loop(values: Tensor) -> bool:
    """Whether a compiled loop computes this: on a processor, no gradient, no export and no `torch.compile`."""
    is_plain = values.device.type == "cpu" and values.dtype == torch.float32 and not values.requires_grad
    return is_plain and not torch.compiler.is_compiling()


def _around(planes: Float[Tensor, "b c m m"]) -> Float[Tensor, "b c m m"]:
    """Means over windows of three cells, zeros beyond the border; several times as fast as torch's on a processor."""
    planes = pad(planes, (1, 1, 1, 1))
    rows = planes[..., :-2, :] + planes[..., 1:-1, :] + planes[..., 2:, :]
    return (rows[..., :-2] + rows[..., 1:-1] + rows[..., 2:]) / 9


def _cells(
    loop: Callable[..., None], values: Float[Tensor, "b c p p"], half_strength: float
) -> Float[Tensor, "b 2 n n"]:
    """Cells of two pixels by one of the loops of `refinenet.models.kernels`."""
    b, _, p, q = values.shape
    result = values.new_empty((b, 2, p // 2, q // 2))
    loop(values.contiguous().numpy(), np.float32(half_strength**2), result.numpy())
    return result


def feature_gradients(values: Float[Tensor, "b c p p"]) -> tuple[Float[Tensor, "b c p p"], Float[Tensor, "b c p p"]]:
    """Change over two pixels to the right and down, smoothed across as in `image.edge_gradients`."""
    padded = pad(values, (1, 1, 1, 1), mode="replicate")
    across, down = padded[..., 2:] - padded[..., :-2], padded[..., 2:, :] - padded[..., :-2, :]
    dx = (across[..., :-2, :] + 2 * across[..., 1:-1, :] + across[..., 2:, :]) / 4
    dy = (down[..., :-2] + 2 * down[..., 1:-1] + down[..., 2:]) / 4
    return dx, dy


def orientations(values: Float[Tensor, "b c p p"], half_strength: float) -> Float[Tensor, "b 2 n n"]:
    """Cosine and sine of twice the angle of the strongest channel's gradient, times a strength under 1.

    Means over cells of two pixels.
    """
    if has_loop(values):
        return _cells(strongest_gradient, values, half_strength)
    dx, dy = feature_gradients(values)
    x, y = dx[:, :1], dy[:, :1]
    square = x.square() + y.square()
    for i in range(1, values.shape[1]):  # argmax over channels strided in memory takes several times as long
        other_x, other_y = dx[:, i : i + 1], dy[:, i : i + 1]
        other = other_x.square() + other_y.square()
        more = other > square
        x, y, square = torch.where(more, other_x, x), torch.where(more, other_y, y), torch.where(more, other, square)
    weight = square / (square + half_strength**2) / (square + 1e-3)
    return avg_pool2d(torch.cat(((x * x - y * y) * weight, 2 * x * y * weight), 1), 2)


def directions(values: Float[Tensor, "b 3 p p"], half_strength: float) -> Float[Tensor, "b 2 n n"]:
    """Cosine and sine of the lightness gradient's angle, times a strength under 1; means over cells of two pixels."""
    if has_loop(values):
        return _cells(lightness_gradient, values, half_strength)
    dx, dy = feature_gradients(values.mean(1, keepdim=True))
    weight = torch.rsqrt(dx.square() + dy.square() + half_strength**2)
    return avg_pool2d(torch.cat((dx * weight, dy * weight), 1), 2)
