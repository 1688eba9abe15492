"""Poses of an image refined by a network or a baseline, and whole BOP result files."""
