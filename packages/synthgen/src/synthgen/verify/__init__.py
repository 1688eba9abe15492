"""Proof that a shard dataset is what its card says: named checks, coverage, and a page that shows both."""
