"""The report's page: one file, light, readable from 360 px to wide screens, nothing loaded from elsewhere."""

from evalkit.report.html.document import page
from evalkit.report.html.elements import (
    Section,
    Shot,
    beside,
    case,
    cases,
    definitions,
    fold,
    heading,
    items,
    paragraph,
    text,
)
from evalkit.report.html.table import table

__all__ = [
    "Section",
    "Shot",
    "beside",
    "case",
    "cases",
    "definitions",
    "fold",
    "heading",
    "items",
    "page",
    "paragraph",
    "table",
    "text",
]
