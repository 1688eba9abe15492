"""Pose refinement: networks, their training on pair shards, and refinement of BOP estimates."""

from posecore.renamed import refuse_renamed_modules

from refinenet.renamed import MODULES

__version__ = "0.1.0"

refuse_renamed_modules(MODULES)
