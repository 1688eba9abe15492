"""Text tables: their model, the report's and the paper's tables, Markdown, LaTeX, CSV and JSON."""
