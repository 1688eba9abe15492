"""Creation of engines by name."""

from posecore.errors import ConfigError

from synthgen.engine import Engine
from synthgen.names import ENGINE_NAMES, Device


def make_engine(name: str, *, threads: int = 0, device: Device = "cpu") -> Engine:
    """Create an engine by name; its dependencies are imported only here.

    Args:
        name: 'cycles' (path tracing, the default elsewhere), 'eevee' (for GPUs) or 'raster' (drafts, no Blender).
        threads: Number of threads of a Blender engine, 0 for all cores.
        device: Device of Cycles; the other engines draw with OpenGL's device.

    Raises:
        ConfigError: The name is unknown.
        RenderError: The engine cannot start here, e.g. because Blender's module is not installed.
    """
    if name == "raster":
        from synthgen.engines.raster import RasterEngine

        return RasterEngine()
    if name == "cycles" or name == "eevee":
        from synthgen.engines.blender.engine import BlenderEngine

        return BlenderEngine(name, threads=threads, device=device)
    raise ConfigError(f"engine: got {name!r}, expected one of {', '.join(ENGINE_NAMES)}")
