"""Inputs of a dataset, loaded: meshes with their symmetries, photographs, panoramas, occluders."""
