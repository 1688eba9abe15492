"""A whole page in one file, with style and script inside."""

from collections.abc import Sequence
from functools import cache
from html import escape
from importlib.resources import files

from posecore.html import document

from evalkit.report.html.elements import Section


@cache
def _asset(name: str) -> str:
    return files("evalkit.report.html").joinpath(name).read_text(encoding="utf-8")


def page(title: str, head: str, sections: Sequence[Section]) -> str:
    """A document: title, head, table of contents, and the sections that are not empty.

    Args:
        title: plain text.
        head: HTML between the title and the first section.
        sections: with different headings.
    """
    shown = [section for section in sections if not section.is_empty]
    links = "".join(f'<li><a href="#{section.anchor}">{escape(section.heading)}</a></li>' for section in shown)
    body = "".join(
        f'<section id="{section.anchor}"><h2>{escape(section.heading)}</h2>{"".join(section.parts)}</section>'
        for section in shown
    )
    content = (
        f'<nav class="contents" aria-label="Contents"><ul>{links}</ul></nav>'
        f"<main><header><h1>{escape(title)}</h1>{head}</header>{body}</main>"
    )
    return document(title, _asset("style.css"), content, _asset("sort.js"))
