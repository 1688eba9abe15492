"""The examples of the page "Use from Python": names and arguments exist, and all of them run one after the other."""

import ast
import importlib
import inspect
import re
import sys
import textwrap
from collections.abc import Iterator
from pathlib import Path

import pytest
from children import run

REPOSITORY = Path(__file__).resolve().parent.parent
PAGE = REPOSITORY / "docs" / "python.md"
FILES = {"synthgen.json"}
JOBS = {"RenderJob", "BopJob", "RefineJob", "TrackJob", "PerturbJob", "ReportJob"}


def examples() -> list[str]:
    return re.findall(r"^```python\n(.*?)^```$", PAGE.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)


def tree() -> ast.Module:
    """All examples as one module."""
    return ast.parse("\n".join(examples()), str(PAGE))


def imported() -> dict[str, object]:
    """Every name that the examples import, by the name that they use."""
    names: dict[str, object] = {}
    for node in ast.walk(tree()):
        if isinstance(node, ast.ImportFrom):
            module = importlib.import_module(node.module)
            for alias in node.names:
                names[alias.asname or alias.name] = getattr(module, alias.name)
    return names


def calls() -> Iterator[tuple[str, ast.Call]]:
    """Every call of a plain name."""
    for node in ast.walk(tree()):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
            yield node.func.id, node


def test_every_part_of_the_page_has_an_example():
    page = PAGE.read_text(encoding="utf-8")
    sections = re.split(r"^## ", page, flags=re.MULTILINE)[1:]
    assert len(sections) >= 7
    assert [section.splitlines()[0] for section in sections if "```python" not in section] == []
    assert {name for name, _ in calls()} >= JOBS


def test_imports_exist():
    assert imported().keys() >= JOBS


def test_functions_of_the_table_exist():
    rows = re.findall(r"^\| `(\w+ \w+)` \| `([\w.]+)` \| `(\w+)` \|$", PAGE.read_text(encoding="utf-8"), re.MULTILINE)
    assert len(rows) == 7
    for _, function, _ in rows:
        module, _, name = function.rpartition(".")
        assert callable(getattr(importlib.import_module(module), name))


def test_dotted_names_of_all_pages_exist():
    pages = [REPOSITORY / "README.md", *(REPOSITORY / "docs").rglob("*.md"), *REPOSITORY.glob("packages/*/README.md")]
    text = "\n".join(page.read_text(encoding="utf-8") for page in pages)
    names = set(re.findall(r"`((?:posecore|synthgen|refinenet|evalkit)(?:\.[A-Za-z_]\w*)+)\b(?:\([^`]*\))?`", text))
    assert len(names) > 20
    assert sorted(name for name in names - FILES if not exists(name)) == []


def exists(name: str) -> bool:
    """Whether a dotted name is a module, or an attribute of one."""
    parts = name.split(".")
    for length in range(len(parts), 0, -1):
        try:
            value = importlib.import_module(".".join(parts[:length]))
        except ModuleNotFoundError:
            continue
        for part in parts[length:]:
            value = getattr(value, part, None)
        return value is not None
    return False


def test_arguments_of_calls_exist():
    names = imported()
    checked = set()
    for name, call in calls():
        if name not in names:
            continue
        signature = inspect.signature(names[name])
        keywords = {keyword.arg: None for keyword in call.keywords if keyword.arg}
        signature.bind(*[None] * len(call.args), **keywords)
        checked.add(name)
    assert checked >= JOBS


@pytest.mark.slow
def test_examples_run(tmp_path):
    (tmp_path / "examples").symlink_to(REPOSITORY / "examples")
    body = textwrap.indent("\n".join(examples()), "    ")
    script = tmp_path / "script.py"
    script.write_text(f"def main():\n{body}\n\n\nif __name__ == '__main__':\n    main()\n", encoding="utf-8")
    done = run([sys.executable, script.name], cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    for name in ("run/best.safetensors", "refined.csv", "track.csv", "report/index.html"):
        assert (tmp_path / name).is_file(), name
