"""What the rasteriser draws, and the layers that it returns."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from posecore.errors import RenderError

MAX_LIGHTS = 8


@dataclass(frozen=True, kw_only=True)
class DirectionalLight:
    """A light from infinity: unit direction towards it in the camera frame, and its colour."""

    direction_cam: tuple[float, float, float]
    rgb: tuple[float, float, float] = (1.0, 1.0, 1.0)


@dataclass(frozen=True, kw_only=True)
class Shading:
    """Light model in display values: own colour x (ambient + diffuse x lights). Without lights, a headlight."""

    ambient: float = 0.5
    diffuse: float = 0.5
    lights: tuple[DirectionalLight, ...] = ()

    def __post_init__(self) -> None:
        if len(self.lights) > MAX_LIGHTS:
            raise RenderError(f"shading has {len(self.lights)} lights, expected at most {MAX_LIGHTS}")


HEADLIGHT = Shading()


@dataclass(frozen=True, kw_only=True, eq=False)
class Instance:
    """One object of a scene: which mesh, where, and a factor on its colours."""

    obj_id: int
    T_cam_obj: Float[np.ndarray, "4 4"]
    tint: tuple[float, float, float] = (1.0, 1.0, 1.0)


@dataclass(frozen=True, kw_only=True, eq=False)
class Layers:
    """A batch of renders of one object each.

    Attributes:
        rgb: (b, h, w, 3) display colours on black, or None when not asked for.
        depth_m: (b, h, w) camera z in metres, 0 where nothing was hit.
    """

    rgb: UInt8[np.ndarray, "b h w 3"] | None
    depth_m: Float[np.ndarray, "b h w"]

    @property
    def mask(self) -> Bool[np.ndarray, "b h w"]:
        """Silhouettes."""
        return self.depth_m > 0


@dataclass(frozen=True, kw_only=True, eq=False)
class SceneLayers:
    """One render of several objects; `instance` indexes them, -1 where nothing was hit; `rgb` may not be asked for."""

    rgb: UInt8[np.ndarray, "h w 3"] | None
    depth_m: Float[np.ndarray, "h w"]
    instance: Int[np.ndarray, "h w"]
