"""Text cells of CSV files: a spreadsheet must not take a name for a formula."""

import re

_MARK = "'"
_NUMBER = r"[-+]?(\d+\.?\d*|\.\d+)(e[-+]?\d+)?"
_HARMLESS = re.compile(rf"-|{_NUMBER}( ?%)?( [(\[]{_NUMBER}((, | to |–){_NUMBER})*[)\]])?", re.IGNORECASE | re.ASCII)
"""No value, and a number, with others in brackets: `cell_text` writes these, and no spreadsheet runs them."""
_FORMULA = ("=", "+", "-", "@", "\t", "\r", _MARK)


def escaped(text: str) -> str:
    """Text with an apostrophe before it where a spreadsheet would take it for a formula (OWASP, CSV injection)."""
    return _MARK + text if text.startswith(_FORMULA) and not _HARMLESS.fullmatch(text) else text


def unescaped(cell: str) -> str:
    """The text of a cell that `escaped` made."""
    return cell[1:] if cell.startswith(tuple(_MARK + first for first in _FORMULA)) else cell
