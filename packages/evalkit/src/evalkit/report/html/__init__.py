"""The report's page: one file without external resources, readable from 360 px to wide screens."""

from posecore.html import definitions

from evalkit.report.html.document import page
from evalkit.report.html.elements import (
    Picture,
    Section,
    beside,
    case,
    cases,
    fold,
    heading,
    items,
    paragraph,
    text,
)
from evalkit.report.html.table import table

__all__ = [
    "Picture",
    "Section",
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
