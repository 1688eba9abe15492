"""Verification of a shard dataset against its data card: named checks, coverage, and a page with both."""
