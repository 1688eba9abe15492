"""Refiners without a network, for comparison: edges, depth, colour regions."""
