"""Pose refinement: networks, their training on pair shards, and refinement of BOP estimates."""

from posecore.renamed import refuse_renamed_modules

__version__ = "0.1.0"

refuse_renamed_modules(
    {
        "refinenet.methods": "refinenet.refiner and refinenet.refine.registry",
        "refinenet.tracker": "refinenet.tracking.tracker",
        "refinenet.views": "refinenet.refine.patches",
    }
)
