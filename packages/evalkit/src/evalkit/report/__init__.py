"""The HTML report: summary, plots, pictures and page."""
