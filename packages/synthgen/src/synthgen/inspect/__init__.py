"""Summaries and pictures of datasets, reproduced samples, and checks of this machine."""
