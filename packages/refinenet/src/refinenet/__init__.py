"""Pose refinement: networks, their training on pair shards, and refinement of BOP estimates."""

__version__ = "0.1.0"
