"""Shared ground of the pose packages: transforms, camera, mesh, rasteriser, contours, BOP files, shards.

Frames, units and pixel conventions are those of `data_specs/conventions.md`: metres, radians, float64,
OpenCV camera axes, pixel centres at +0.5.
"""

from posecore.renamed import refuse_renamed_modules

refuse_renamed_modules({"posecore.raster_reference": "posecore.raster.reference"})
