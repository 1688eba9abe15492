"""The documentation: drawings from text, generated pages, and a site that works from disk and loads nothing remote."""

import importlib.util
import re
import shlex
import sys
from collections.abc import Iterator
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
from children import run
from posecore import config as config_tools

REPOSITORY = Path(__file__).resolve().parent.parent


@cache
def module(name: str):
    spec = importlib.util.spec_from_file_location(f"docs_{name}", REPOSITORY / "docs" / f"{name}.py")
    loaded = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = loaded  # dataclasses look their module up
    spec.loader.exec_module(loaded)
    return loaded


def pages() -> list[Path]:
    return [REPOSITORY / "README.md", *(REPOSITORY / "docs").rglob("*.md"), *REPOSITORY.glob("packages/*/README.md")]


def written_commands() -> Iterator[tuple[str, list[str]]]:
    """Page and words of every command of the project in a code block, continued lines joined."""
    for page in pages():
        text = page.read_text(encoding="utf-8").replace("\\\n", " ")
        for line in re.findall(rf"^(?:    )?((?:{'|'.join(module('hooks').PROGRAMS)}) [a-z].*)$", text, re.MULTILINE):
            yield page.relative_to(REPOSITORY).as_posix(), shlex.split(line, comments=True)


def boxes(svg: str) -> list[tuple[str, float, float, float]]:
    """Class, x, y and width of each box."""
    rectangles = [rectangle for rectangle in ElementTree.fromstring(svg).iter("rect")]
    return [(r.get("class"), float(r.get("x")), float(r.get("y")), float(r.get("width"))) for r in rectangles]


def test_a_flow_runs_from_left_to_right_and_names_every_box_once():
    svg = module("drawings").flow("[mesh] -> render -> [shards | Zarr & co]\n[images] -> cut -> [shards]\n")
    texts = [text.text for text in ElementTree.fromstring(svg).iter("text")]
    assert sorted(texts) == ["Zarr & co", "cut", "images", "mesh", "render", "shards"]
    kinds = dict(zip(["mesh", "render", "shards", "images", "cut"], boxes(svg), strict=True))
    assert [kinds[name][0] for name in ("mesh", "render", "shards")] == ["file", "command", "file"]
    assert kinds["mesh"][1] < kinds["render"][1] < kinds["shards"][1]
    assert kinds["mesh"][1] == kinds["images"][1]
    assert svg.count('class="edge"') == 4


def test_boxes_of_a_flow_never_overlap():
    text = "[a] -> b -> [c] -> d\n[e] -> b\n[f] -> d\n[c] -> g\n" + " -> ".join(
        f"a long step number {i}" for i in range(9)
    )
    svg = module("drawings").flow(text)
    rectangles = [(x, y, x + width, y + module("drawings").BOX_PX) for _, x, y, width in boxes(svg)]
    for i, first in enumerate(rectangles):
        for second in rectangles[:i]:
            beside = first[2] < second[0] or second[2] < first[0]
            assert beside or first[3] < second[1] or second[3] < first[1]


def test_a_wide_flow_runs_downwards():
    svg = module("drawings").flow(" -> ".join(f"a long step number {i}" for i in range(9)))
    assert len({x for _, x, _, _ in boxes(svg)}) == 1
    assert float(ElementTree.fromstring(svg).get("width")) < module("drawings").WIDEST_PX


def test_a_circle_of_arrows_is_refused():
    with pytest.raises(ValueError, match="circle"):
        module("drawings").flow("[a] -> b -> [a]")


def test_bars_are_as_long_as_their_values():
    svg = module("drawings").bars("one | 10 | 10 mm\nhalf | 5\n")
    lengths = [width for _, _, _, width in boxes(svg)]
    assert lengths == [360, 180]
    assert [text.text for text in ElementTree.fromstring(svg).iter("text")] == ["one", "10 mm", "half", "5"]


def test_options_of_written_commands_exist():
    options = {
        name: {option for parameter in command.params for option in (*parameter.opts, *parameter.secondary_opts)}
        for program in module("hooks").PROGRAMS
        for name, command in module("hooks").commands(program)
    }
    unknown = [
        f"{page}: {' '.join(words[:2])} {word}"
        for page, words in written_commands()
        for word in words[2:]
        if word.startswith("--") and word.split("=")[0] not in {*options[" ".join(words[:2])], "--help"}
    ]
    assert unknown == []


def test_keys_of_written_commands_exist():
    synthgen = importlib.import_module("synthgen.config")
    scenes = keys(config_tools.to_dict(synthgen.SynthConfig()))
    training = set(re.findall(r"^\| `([\w.]+)` \|", module("hooks").training_keys_page(), re.MULTILINE))
    known = {"synthgen render": scenes, "synthgen bop": scenes, "refinenet train": training}
    unknown = [
        f"{page}: {value}"
        for page, words in written_commands()
        for option, value in pairwise(words)
        if option == "--set" and "=" in value and not is_key(value.split("=")[0], known.get(" ".join(words[:2])))
    ]
    assert unknown == []


def is_key(key: str, known: set[str] | None) -> bool:
    return known is None or key.isupper() or key == "key" or key in known


def keys(config: dict[str, Any], prefix: str = "") -> set[str]:
    nested = [keys(value, f"{prefix}{name}.") for name, value in config.items() if isinstance(value, dict)]
    return {f"{prefix}{name}" for name in config}.union(*nested)


def test_every_training_key_is_documented():
    page = module("hooks").training_keys_page()
    rows = re.findall(r"^\| `([\w.]+)` \| .* \| (.*) \|$", page, re.MULTILINE)
    keys = {name for name, _ in rows}
    assert {"batch", "hypothesis.max_angle_deg", "network.backbone.name", "optimiser.ema_decay"} <= keys
    assert [name for name, meaning in rows if not meaning] == []


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    """The built pages; a warning stops the build."""
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)]
    done = run(command, cwd=REPOSITORY)
    assert done.returncode == 0, done.stderr
    return folder


@pytest.mark.slow
def test_pages_load_nothing_from_elsewhere(site):
    loading = re.compile(
        r"""<(?:script|img|iframe|source|video)[^>]*\ssrc=["']?(?:https?:)?//|url\(["']?(?:https?:)?//"""
    )
    linked = re.compile(r"""<link[^>]*rel=["']?(?:stylesheet|preconnect|icon)["']?[^>]*href=["']?(?:https?:)?//""")
    pages = [*site.rglob("*.html"), *site.rglob("*.css")]
    assert len(pages) > 30
    for page in pages:
        text = page.read_text(encoding="utf-8")
        assert not loading.search(text), page
        assert not linked.search(text), page


@pytest.mark.slow
def test_search_works_from_disk(site):
    """Browsers fetch no JSON and start no worker from disk: the index is a script, workers run in frames."""
    assert "perturbation" in (site / "search" / "search_index.js").read_text(encoding="utf-8")
    assert 'src="../scripts/iframe-worker.js"' in (site / "experiments" / "lmo.html").read_text(encoding="utf-8")
    assert (site / "scripts" / "iframe-worker.js").is_file()


def test_drawings_and_generated_tables_are_in_the_pages(site):
    assert '<svg class="drawing"' in (site / "architecture.html").read_text(encoding="utf-8")
    assert "distance zeros" in (site / "verifying.html").read_text(encoding="utf-8")
    assert "<!-- checks -->" not in (site / "verifying.html").read_text(encoding="utf-8")


def test_pictures_are_small():
    limits = {".gif": 1_500_000, ".mp4": 1_500_000, ".jpg": 200_000, ".png": 200_000}
    for picture in (REPOSITORY / "docs" / "pictures").iterdir():
        assert picture.stat().st_size < limits[picture.suffix], picture.name
