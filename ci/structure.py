"""Counts what the layout promises, and lists each place that breaks a promise; `make lint` runs it.

    python ci/structure.py            # everything; exit status 1 if a promise is broken
    python ci/structure.py refinenet  # one package

Sizes: modules a folder, lines a module, a function and a command function. Names: public classes of one name,
words that have a standard term in computer vision (`TERMS`). English: verbs of a person for code (`VERBS`), and
"of it", "of one", "of them" without their noun, in docstrings, comments, messages and pages.
"""

import ast
import io
import re
import sys
import tokenize
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("posecore", "synthgen", "refinenet", "evalkit")
MOST_MODULES = 14
MOST_LINES = 400
MOST_FUNCTION_LINES = 60
MOST_COMMAND_LINES = 45
ONE_SUBJECT: set[str] = set()
"""Longer modules that are one subject, by path from the root."""
TABLES_OF_OLD_NAMES = {"renamed", "renamed_keys", "migration"}
"""Modules whose strings are names of earlier versions."""
FLAT = {"packages/posecore/src/posecore"}
"""Folders that are flat on purpose."""

TERMS = {
    r"twins?": "symmetry-equivalent pose, reference implementation",
    r"closeness": "confidence, pose quality",
    r"agreement": "gradient similarity",
    r"recut": "online crop",
    r"own_predictions?|OwnPredictions?": "on-policy hypotheses",
    r"held_out|HeldOut": "validation set",
    r"(un)?seeable": "visible",
    r"backdrops?": "background",
    r"occlusion_leaves": "min_visible_fraction",
    r"[Ss]tart_?poses?|STARTS?": "initial pose",
    r"Sighting|Standing": "Observation, TrackStatus",
    r"CleanGroup": "ErrorReportingGroup",
    r"any_twin": "sample_symmetries",
    r"\w*_share|share_\w+|shares?": "fraction",
    r"truths?|true_pose": "ground truth, gt",
}
"""Identifiers that have a standard term."""
VAGUE = {
    "found", "of", "known", "one", "own", "said", "told", "wanted", "place", "places", "apart", "far_away", "given",
    "turned", "guess", "look", "looks", "left_over",
}  # fmt: skip
"""Names of variables, parameters and functions that are no nouns."""
PHRASES = {
    r"start pose": "initial pose",
    r"\btwins?\b": "symmetry-equivalent pose, or reference implementation",
    r"\bcloseness\b": "pose quality",
    r"\bheld[- ]out (set|pairs|data)\b": "validation",
    r"\bown predictions\b": "on-policy hypotheses",
    r"\bbackdrop": "background",
}
VERBS = r"\b(tells?|told|says?|said|saying|wants?|wanted|knows|knew|looks)\b"
WITHOUT_NOUN = r"\bof (it|them)\b|\bof one\b(?! [a-z])"


def main(packages: list[str]) -> int:
    """Print every broken promise; the number of them is the exit status' reason."""
    broken: dict[str, list[str]] = defaultdict(list)
    classes: dict[str, list[str]] = defaultdict(list)
    for package in packages or PACKAGES:
        source = ROOT / "packages" / package / "src" / package
        _folders(source, broken)
        for file in sorted(source.rglob("*.py")):
            _module(file, classes, broken)
    for name, places in classes.items():
        if len(places) > 1:
            broken["two public classes of one name"].append(f"{name}: {', '.join(places)}")
    if not packages:
        for page in [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]:
            _text(page, page.read_text(encoding="utf-8").split("\n"), broken)
    for promise, places in broken.items():
        print(f"{promise}: {len(places)}")
        print("".join(f"    {place}\n" for place in places), end="")
    print(f"{sum(map(len, broken.values()))} places")
    return 1 if broken else 0


def _folders(source: Path, broken: dict[str, list[str]]) -> None:
    for folder in [source, *(path for path in source.rglob("*") if path.is_dir())]:
        modules = [file for file in folder.glob("*.py") if not file.name.startswith("__")]
        name = folder.relative_to(ROOT).as_posix()
        if len(modules) > MOST_MODULES and name not in FLAT:
            broken[f"more than {MOST_MODULES} modules in a folder"].append(f"{name}: {len(modules)}")


def _module(file: Path, classes: dict[str, list[str]], broken: dict[str, list[str]]) -> None:
    name, text = file.relative_to(ROOT).as_posix(), file.read_text(encoding="utf-8")
    lines = text.count("\n")
    if lines > MOST_LINES and name not in ONE_SUBJECT:
        broken[f"more than {MOST_LINES} lines in a module"].append(f"{name}: {lines}")
    tree = ast.parse(text)
    for node in tree.body:
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
            classes[node.name].append(name)
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            _function(node, name, broken)
        for word, line in _names(node):
            if term := _better(word):
                broken["words that have a standard term"].append(f"{name}:{line}: {word} -> {term}")
            elif word in VAGUE:
                broken["names that are no nouns"].append(f"{name}:{line}: {word}")
    if file.stem not in TABLES_OF_OLD_NAMES:
        _text(file, _prose(text, tree), broken)


def _function(node: ast.FunctionDef | ast.AsyncFunctionDef, name: str, broken: dict[str, list[str]]) -> None:
    lines = (node.end_lineno or node.lineno) - node.lineno + 1
    if any("command" in ast.unparse(decorator) for decorator in node.decorator_list):
        first = node.body[1] if len(node.body) > 1 and ast.get_docstring(node) else node.body[0]
        lines = (node.end_lineno or node.lineno) - first.lineno + 1
        if lines > MOST_COMMAND_LINES:
            broken[f"more than {MOST_COMMAND_LINES} lines in a command"].append(f"{name}:{node.lineno}: {lines}")
    elif lines > MOST_FUNCTION_LINES:
        broken[f"more than {MOST_FUNCTION_LINES} lines in a function"].append(
            f"{name}:{node.lineno}: {node.name}, {lines}"
        )


def _names(node: ast.AST) -> Iterator[tuple[str, int]]:
    """Names that a node defines, with their lines."""
    if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
        yield node.name.strip("_"), node.lineno
    elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
        yield node.id.strip("_"), node.lineno
    elif isinstance(node, ast.arg):
        yield node.arg.strip("_"), node.lineno
    elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store) and ast.unparse(node.value) == "self":
        yield node.attr.strip("_"), node.lineno


def _better(word: str) -> str | None:
    return next((term for pattern, term in TERMS.items() if re.fullmatch(pattern, word)), None)


def _prose(text: str, tree: ast.Module) -> list[str]:
    """Lines of a module with only its comments and strings on them."""
    prose = [""] * (text.count("\n") + 2)
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type in (tokenize.COMMENT, tokenize.STRING):
            for offset, part in enumerate(token.string.split("\n")):
                prose[token.start[0] - 1 + offset] += " " + part
    return prose


def _text(file: Path, lines: list[str], broken: dict[str, list[str]]) -> None:
    name = file.relative_to(ROOT).as_posix()
    for number, line in enumerate(lines, 1):
        bare = re.sub(r"`[^`]*`", "", line)
        for pattern, term in PHRASES.items():
            if re.search(pattern, bare, re.IGNORECASE):
                broken["words that have a standard term, in prose"].append(f"{name}:{number}: {line.strip()} -> {term}")
        if re.search(VERBS, bare):
            broken["verbs of a person for code"].append(f"{name}:{number}: {line.strip()}")
        if re.search(WITHOUT_NOUN, bare):
            broken["without a noun"].append(f"{name}:{number}: {line.strip()}")


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
