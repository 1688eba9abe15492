"""Text cells of CSV files: a spreadsheet must not take a name for a formula."""

_MARK = "'"
_FORMULA = ("=", "+", "-", "@", "\t", "\r", _MARK)


def escaped(text: str) -> str:
    """Text with an apostrophe before it where a spreadsheet would take it for a formula (OWASP, CSV injection)."""
    return _MARK + text if text.startswith(_FORMULA) and not _is_number(text) else text


def unescaped(cell: str) -> str:
    """The text of a cell that `escaped` made."""
    return cell[1:] if cell.startswith(tuple(_MARK + first for first in _FORMULA)) else cell


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
