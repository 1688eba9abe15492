"""What networks match two patches with: learned features, or gradient orientations, which need no learning."""

import torch
from jaxtyping import Float, UInt8
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d, pad

from refinenet.image.edge_gradients import OUTLINE

HALF_STRENGTH = {"render": 24.0, "scene": 12.0}
"""Gradients, in grey levels over two pixels, that count half: the image's edges are softened by lens and resampling."""
LEAST_AMOUNT = 0.02
"""Share of a window that is edges, under which agreement fades."""


class LocalCorrelation(nn.Module):
    """How well each hypothesis cell matches the scene cells around it: (b, c, n, n) twice to (b, k*k, n/2, n/2).

    Dot products of features over `sqrt(c)`, for every second hypothesis cell in both directions, with the scene cells
    up to `radius` away; scene cells outside the patch match with 0.

    Source: the correlation layer of FlowNet (Dosovitskiy et al., ICCV 2015).
    """

    def __init__(self, cells: int, radius: int) -> None:
        super().__init__()
        self.radius, self.side = radius, 2 * radius + 1
        row, column = torch.meshgrid(torch.arange(0, cells, 2), torch.arange(0, cells, 2), indexing="ij")
        down, right = torch.meshgrid(torch.arange(self.side), torch.arange(self.side), indexing="ij")
        padded = cells + 2 * radius
        where = (row.flatten()[:, None] + down.flatten()) * padded + column.flatten()[:, None] + right.flatten()
        self.register_buffer("where", where[None], persistent=False)
        self.where: Tensor

    def forward(
        self, hypothesis: Float[Tensor, "b c n n"], scene: Float[Tensor, "b c n n"]
    ) -> Float[Tensor, "b k m m"]:
        """Match features of both patches."""
        b, c, n, _ = hypothesis.shape
        r = self.radius
        queries = hypothesis[:, :, ::2, ::2].permute(0, 2, 3, 1).reshape(b, -1, c)
        keys = pad(scene, (r, r, r, r)).permute(0, 2, 3, 1).reshape(b, -1, c)
        all_pairs = torch.bmm(queries, keys.transpose(1, 2)) * c**-0.5
        near = all_pairs.gather(2, self.where.expand(b, -1, -1))
        return near.reshape(b, n // 2, n // 2, -1).permute(0, 3, 1, 2)


class GradientCorrelation(nn.Module):
    """How well gradients of the render agree with the scene's around each cell of four pixels, for every small shift.

    Colours and light of a render are not those of the image, but edges lie in the same places. So what is matched is
    given, not learned: in windows of twelve pixels, by shifts of two pixels up to `radius`, (a) orientations of the
    strongest change of any channel, silhouette included, without their sign, and (b) directions of the change of
    lightness inside the silhouette, with it. Agreement is a share of the edges that the render has there; how many
    these are comes last.

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
        """Match both patches; inputs get no gradient."""
        values, scene = hypothesis_rgb.float(), scene_rgb.float()
        outlined = torch.cat((values, OUTLINE * mask[:, None]), 1)
        inside = avg_pool2d(mask[:, None], 2) > 0.99
        mine = torch.cat(
            (orientations(outlined, HALF_STRENGTH["render"]), directions(values, HALF_STRENGTH["render"]) * inside), 1
        )
        theirs = torch.cat(
            (orientations(scene, HALF_STRENGTH["scene"]), directions(scene, HALF_STRENGTH["scene"])), 1
        )  # fmt: skip
        amounts = torch.stack([torch.linalg.vector_norm(mine[:, i : i + 2], dim=1) for i in (0, 2)], 1)
        amounts = _around(avg_pool2d(amounts, 2))
        agreement = _around(self._agreement(mine, theirs))
        shares = agreement.unflatten(1, (2, -1)) / (amounts[:, :, None] + LEAST_AMOUNT)
        return torch.cat((shares.flatten(1, 2), amounts), 1)

    def _agreement(self, mine: Float[Tensor, "b 4 n n"], theirs: Float[Tensor, "b 4 n n"]) -> Float[Tensor, "b k m m"]:
        """Products for every shift, orientations first, as means of two by two; 0 from beyond the border."""
        n, r = mine.shape[-1], self.radius
        # The batch comes last, where all of it is read at once: half the time of any other layout.
        mine, theirs = mine.permute(1, 2, 3, 0).contiguous(), pad(theirs, (r, r, r, r)).permute(1, 2, 3, 0).contiguous()
        found = []
        for down in range(self.side):
            # all shifts to the right at once, as a view
            product = theirs[:, down : down + n].unfold(2, n, 1).permute(0, 1, 2, 4, 3) * mine[:, :, None]
            product = product[0::2] + product[1::2]
            product = product[:, 0::2] + product[:, 1::2]
            found.append(product[:, :, :, 0::2] + product[:, :, :, 1::2])
        return torch.stack(found, 1).permute(5, 0, 1, 3, 2, 4).flatten(1, 3) / 4


def _around(planes: Float[Tensor, "b c m m"]) -> Float[Tensor, "b c m m"]:
    """Means over windows of three cells, zeros beyond the border; several times as fast as torch's on a processor."""
    planes = pad(planes, (1, 1, 1, 1))
    rows = planes[..., :-2, :] + planes[..., 1:-1, :] + planes[..., 2:, :]
    return (rows[..., :-2] + rows[..., 1:-1] + rows[..., 2:]) / 9


def gradients(values: Float[Tensor, "b c p p"]) -> tuple[Float[Tensor, "b c p p"], Float[Tensor, "b c p p"]]:
    """Change over two pixels to the right and down; counterpart of the first half of `orientation_gradients`."""
    padded = pad(values, (1, 1, 1, 1), mode="replicate")
    across, down = padded[..., 2:] - padded[..., :-2], padded[..., 2:, :] - padded[..., :-2, :]
    dx = (across[..., :-2, :] + 2 * across[..., 1:-1, :] + across[..., 2:, :]) / 4
    dy = (down[..., :-2] + 2 * down[..., 1:-1] + down[..., 2:]) / 4
    return dx, dy


def orientations(values: Float[Tensor, "b c p p"], half_strength: float) -> Float[Tensor, "b 2 n n"]:
    """Cosine and sine of twice the gradient's angle, of the channel that changes most, times a strength under 1.

    Of cells of two pixels: means.
    """
    dx, dy = gradients(values)
    x, y = dx[:, :1], dy[:, :1]
    square = x.square() + y.square()
    for i in range(1, values.shape[1]):  # argmax over channels that lie apart in memory takes several times as long
        other_x, other_y = dx[:, i : i + 1], dy[:, i : i + 1]
        other = other_x.square() + other_y.square()
        more = other > square
        x, y, square = torch.where(more, other_x, x), torch.where(more, other_y, y), torch.where(more, other, square)
    weight = square / (square + half_strength**2) / (square + 1e-3)
    return avg_pool2d(torch.cat(((x * x - y * y) * weight, 2 * x * y * weight), 1), 2)


def directions(values: Float[Tensor, "b 3 p p"], half_strength: float) -> Float[Tensor, "b 2 n n"]:
    """Cosine and sine of the angle of lightness' gradient, times a strength under 1; of cells of two pixels: means."""
    dx, dy = gradients(values.mean(1, keepdim=True))
    weight = torch.rsqrt(dx.square() + dy.square() + half_strength**2)
    return avg_pool2d(torch.cat((dx * weight, dy * weight), 1), 2)
