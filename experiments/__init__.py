"""The experiments of the paper, each a chain of the project's own commands."""
