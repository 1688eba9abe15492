"""Shared ground of the pose packages: transforms, camera, mesh, rasteriser, contours, BOP files, shards.

Frames, units and pixel conventions are those of `data_specs/conventions.md`: metres, radians, float64,
OpenCV camera axes, pixel centres at +0.5.
"""

from posecore.renamed import refuse_renamed_modules

refuse_renamed_modules(
    {
        "posecore.bop.Target": "posecore.bop.BopTarget",
        "posecore.bop.stored": "posecore.bop.file_slice",
        "posecore.bop.table_of": "posecore.bop.estimate_table",
        "posecore.compiled": "posecore.numba_jit",
        "posecore.raster_reference": "posecore.raster.reference",
        "posecore.shard.files": "posecore.shard.sharding_codec",
        "posecore.shard.group": "posecore.shard.layout",
    }
)
