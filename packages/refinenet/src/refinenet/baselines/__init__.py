"""Refiners without a network: edges, depth, colour regions, and a search that takes starts that are far off."""
