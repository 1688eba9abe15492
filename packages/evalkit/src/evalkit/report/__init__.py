"""The HTML report: what it says, its plots, pictures and page."""
