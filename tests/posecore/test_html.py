"""Parts of self-contained pages."""

from xml.etree import ElementTree

import pytest
from posecore.html import definitions, document, figure, ticks


def test_a_document_escapes_its_title_and_requests_nothing() -> None:
    page = document("a < b", "p {}", "<p>text</p>", "let x = 1")
    assert "<title>a &lt; b</title>" in page and "<p>text</p><script>let x = 1</script></body>" in page
    assert "http" not in page and "<script>" not in document("t", "", "")


def test_definitions_and_figures_are_well_formed_and_escaped() -> None:
    assert definitions({}) == ""
    terms = ElementTree.fromstring(definitions({"R & t": "pose < truth"}))
    assert [child.text for child in terms] == ["R & t", "pose < truth"]
    drawn = ElementTree.fromstring(figure("a & b", "1 < 2", '<path d="M0 0"/>', (460, 250.0), kind="wide", note="<p/>"))
    svg = drawn.find("svg")
    assert svg is not None and svg.get("viewBox") == "0 0 460 250" and drawn.get("class") == "wide"
    assert [child.tag for child in svg] == ["title", "desc", "path"] and drawn[-1].tag == "p"


@pytest.mark.parametrize(
    ("low", "high", "expected"),
    [(0, 1, [0, 0.2, 0.4, 0.6, 0.8, 1]), (-180, 180, [-100, 0, 100]), (3, 4.5, [3, 3.5, 4, 4.5]), (0, 0, [0])],
)
def test_ticks_are_round_numbers_within_the_axis(low: float, high: float, expected: list[float]) -> None:
    assert ticks(low, high) == pytest.approx(expected)
