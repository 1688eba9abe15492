"""Contract of the rendering engines."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, Int16
from posecore.mesh import Mesh

from synthgen.scene import Scene


@dataclass(frozen=True, kw_only=True, eq=False)
class RenderedScene:
    """Layers of a rendered region; row 0 is the top.

    Attributes:
        rgb_linear: (h, w, 3) linear scene radiance, straight (not multiplied by alpha); 0 where alpha is 0.
        alpha: (h, w) coverage of the pixel in [0, 1], antialiased.
        depth_m: (h, w) camera z of the surface at the pixel's centre, 0 for background.
        index: (h, w) position in `Scene.objects` of the surface at the pixel's centre, -1 for background.
            `index >= 0` exactly where `depth_m > 0`.
    """

    rgb_linear: Float[np.ndarray, "h w 3"]
    alpha: Float[np.ndarray, "h w"]
    depth_m: Float[np.ndarray, "h w"]
    index: Int16[np.ndarray, "h w"]


@runtime_checkable
class Engine(Protocol):
    """Renders scenes to layers. An engine lives in a single process and renders any number of scenes."""

    name: str

    def load(self, meshes: Mapping[int, Mesh]) -> None:
        """Load meshes under their keys; a mesh with a loaded key replaces the earlier mesh.

        Raises:
            MeshError: The engine cannot take a mesh.
        """

    def render(self, scene: Scene) -> RenderedScene:
        """Render `scene.region_px`.

        The result depends on the scene and the loaded meshes alone: not on earlier scenes or the number of threads.

        Raises:
            RenderError: A mesh key is not loaded, or the renderer failed.
        """

    def close(self) -> None:
        """Release the engine's resources. Closing twice does nothing."""
