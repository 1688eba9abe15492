"""Pieces of a page: sections, paragraphs, cases with pictures. Every text is escaped here."""

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape


@dataclass(frozen=True, kw_only=True)
class Picture:
    """One picture of a case: name of the result file, image as a data URL, caption."""

    name: str
    url: str
    caption: str


@dataclass(frozen=True, kw_only=True)
class Section:
    """A headed part of a page; one without parts is left out."""

    heading: str
    parts: Sequence[str]

    @property
    def is_empty(self) -> bool:
        """Whether the section has no content."""
        return not any(self.parts)

    @property
    def anchor(self) -> str:
        """Fragment identifier in the page, unique as headings are."""
        return "".join(char if char.isalnum() else "-" for char in self.heading.lower())


def case(title: str, pictures: Sequence[Picture]) -> str:
    """One pose in several result files, side by side."""
    figures = "".join(
        f'<figure><img src="{picture.url}" alt="{escape(title)}: {escape(picture.name)}, {escape(picture.caption)}" '
        'width="300" height="300" decoding="async">'
        f"<figcaption><b>{escape(picture.name)}</b><br>{escape(picture.caption)}</figcaption></figure>"
        for picture in pictures
    )
    return f'<article class="case"><h3>{escape(title)}</h3><div class="shots">{figures}</div></article>'


def cases(articles: Sequence[str], pictures_each: int) -> str:
    """A grid of cases, each wide enough for its pictures."""
    width = 20 + 158 * max(1, min(pictures_each, 4))
    return f'<div class="cases" style="--case: {width}px">{"".join(articles)}</div>'


def text(plain: str) -> str:
    """Plain text as HTML."""
    return escape(plain)


def heading(text: str) -> str:
    """A heading within a section."""
    return f"<h3>{escape(text)}</h3>"


def paragraph(text: str, soft: bool = False) -> str:
    """Plain text."""
    return f'<p class="soft">{escape(text)}</p>' if soft else f"<p>{escape(text)}</p>"


def items(texts: Sequence[str]) -> str:
    """A list."""
    return f"<ul>{''.join(f'<li>{escape(text)}</li>' for text in texts)}</ul>" if texts else ""


def fold(label: str, *parts: str) -> str:
    """Parts shown on demand and in print."""
    content = "".join(parts)
    return f"<details><summary>{escape(label)}</summary>{content}</details>" if content else ""


def beside(*parts: str) -> str:
    """Parts side by side where there is room."""
    content = "".join(part for part in parts if part)
    return f'<div class="beside">{content}</div>' if content else ""
