"""Shards to batches: splits, pairs, loader processes, validation pairs."""
