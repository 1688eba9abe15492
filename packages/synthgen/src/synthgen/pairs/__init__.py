"""Scene and hypothesis patches with their labels: rendered, or cut out of annotated images."""
