"""Datasets of any size: shards on processes and clusters, faults, locks, estimates."""
