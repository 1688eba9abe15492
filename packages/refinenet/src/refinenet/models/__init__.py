"""Networks, their checkpoints, and their export."""
