"""Training pairs and test images for 6D pose refinement, rendered from a mesh."""
