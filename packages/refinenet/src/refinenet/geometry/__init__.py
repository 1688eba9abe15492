"""Pose updates in torch, with gradients, and symmetry-equivalent poses."""
