"""BOP datasets: frames of many objects, and sequences."""
