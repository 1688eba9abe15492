"""Pages that are made from the project itself when the documentation is built, so that they cannot fall behind it."""

import dataclasses
import html
import importlib
import inspect
import re
import sys
import typing
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click
import yaml
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

sys.path.insert(0, str(Path(__file__).resolve().parent))
import drawings

ROOT = Path(__file__).resolve().parent.parent
PROGRAMS = ("synthgen", "refinenet", "evalkit")


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the generated pages (called by mkdocs)."""
    pages = {
        "conventions.md": (ROOT / "data_specs" / "conventions.md").read_text(encoding="utf-8"),
        "changelog.md": (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"),
        "data-format.md": data_format_page(),
        "cli.md": cli_page(),
        "training-keys.md": training_keys_page(),
    }
    for name, content in pages.items():
        files.append(File.generated(config, name, content=content))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Insert the table of checks and the drawings (called by mkdocs)."""
    return drawings.draw(markdown.replace("<!-- checks -->", checks_table()))


def checks_table() -> str:
    """Return what `synthgen verify` checks, from its own list."""
    findings = importlib.import_module("synthgen.verify.findings")
    rows = [(name, _cell(what), tolerance) for name, (what, tolerance) in findings.DATASET_CHECKS.items()]
    for check in importlib.import_module("synthgen.verify.checks").CHECKS:
        what = f"{check.what} On the re-rendered samples." if check.rerendered else check.what
        text = f"{_cell(what)}<br><small>Tolerance: {_cell(check.why)}.</small>"
        rows.append((check.name, text, findings.tolerance_text(check.tolerance, check.unit)))
    lines = ["| check | what holds | tolerance |", "|---|---|---|"]
    return "\n".join([*lines, *(f"| {name} | {what} | {_cell(tolerance)} |" for name, what, tolerance in rows)])


def commands(program: str) -> Iterator[tuple[str, click.Command]]:
    """Yield (full name, command) for a program and everything below it."""
    root: click.Command = importlib.import_module(f"{program}.cli").main
    stack = [(program, root)]
    while stack:
        name, command = stack.pop()
        yield name, command
        if isinstance(command, click.Group):
            stack += [(f"{name} {child}", command.commands[child]) for child in sorted(command.commands, reverse=True)]


def cli_page() -> str:
    """Return the command-line reference: every command with its help, its arguments and its options."""
    lines = [
        "# Commands",
        "",
        "Made from the programs' own `--help`. Exit codes: 0 done, 1 failed, 2 wrong usage or configuration.",
        "",
    ]
    for program in PROGRAMS:
        for name, command in commands(program):
            lines += [f"{'#' * min(2 + name.count(' '), 4)} {name}", "", *_help_text(command), ""]
            lines += [*_parameters(command), ""]
    return "\n".join(lines)


def training_keys_page() -> str:
    """Return every key of a training configuration, from the dataclasses and their docstrings."""
    config = importlib.import_module("refinenet.config.train")
    lines = [
        "# Training keys",
        "",
        "`--set key=value` changes one key of a preset, `--config FILE` several. Below are the defaults of the "
        "configuration classes; presets override some. The resolved configuration is written beside every checkpoint.",
        "",
    ]
    return "\n".join([*lines, *_key_tables(config.TrainConfig, "")])


def _key_tables(kind: type, prefix: str) -> list[str]:
    """Markdown tables of a configuration class: its plain keys, then one section for each nested class."""
    docs, types = _attribute_docs(kind), typing.get_type_hints(kind)
    rows: list[str] = []
    sections: list[str] = []
    for field in dataclasses.fields(kind):
        nested = next(filter(dataclasses.is_dataclass, [types[field.name], *typing.get_args(types[field.name])]), None)
        if nested is not None:
            sections += ["", f"## {prefix}{field.name}", "", *_key_tables(nested, f"{prefix}{field.name}.")]
        else:
            default = field.default_factory() if callable(field.default_factory) else field.default
            shown = "" if default is dataclasses.MISSING else f"<code>{_cell(_yaml(default))}</code>"
            rows.append(f"| `{prefix}{field.name}` | {shown} | {_sentence(docs.get(field.name, ''))} |")
    return ["| key | default | meaning |", "|---|---|---|", *rows, *sections]


def _attribute_docs(kind: type) -> dict[str, str]:
    """Texts of the `Attributes:` section of a docstring."""
    section = inspect.cleandoc(kind.__doc__ or "").partition("Attributes:\n")[2]
    return {name: " ".join(text.split()) for name, text in re.findall(r"^    (\w+): (.*(?:\n {8}.*)*)", section, re.M)}


def _yaml(value: object) -> str:
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    return f"[{', '.join(map(_yaml, value))}]" if isinstance(value, list | tuple) else str(value) or '""'


def _sentence(text: str) -> str:
    """A docstring's text as a table cell: code stays code, the first letter is a capital."""
    text = " ".join(text.split()).replace("|", "&#124;").replace("*", "&#42;")
    return text[:1].upper() + text[1:]


def _help_text(command: click.Command) -> list[str]:
    """Turn click's help text into Markdown; paragraphs that click is told not to wrap become code."""
    out: list[str] = []
    for paragraph in re.split(r"\n\s*\n", inspect.cleandoc(command.help or "")):
        if paragraph.startswith("\b"):
            title, *rest = paragraph.lstrip("\b\n").splitlines()
            is_title = title.endswith(":")
            body = rest if is_title else [title, *rest]
            out += [title, ""] if is_title else []
            out += ["```text", *inspect.cleandoc("\n".join(body)).splitlines(), "```", ""]
        else:
            out += [paragraph, ""]
    return out


def _parameters(command: click.Command) -> list[str]:
    context = click.Context(command, show_default=True)
    rows: list[str] = []
    for parameter in command.params:
        if isinstance(parameter, click.Option):
            if parameter.hidden:
                continue
            name, text = parameter.get_help_record(context) or ("", "")
        elif not (name := parameter.make_metavar(context)):  # only refused, see `renamed_arguments`
            continue
        else:
            text = "Argument, see above."
        rows.append(f"| <code>{_cell(name)}</code> | {_cell(text)} |")
    return ["| argument or option | meaning |", "|---|---|", *rows] if rows else []


def _cell(text: str) -> str:
    return html.escape(" ".join(text.split()), quote=False).replace("|", "&#124;").replace("*", "&#42;")


def data_format_page() -> str:
    """Return the page on pair shards, its table from `data_specs/shard_fields.yaml`."""
    spec: dict[str, Any] = yaml.safe_load((ROOT / "data_specs" / "shard_fields.yaml").read_text(encoding="utf-8"))
    lines = [
        "# Data format",
        "",
        f"A dataset of training pairs is a Zarr v3 group, schema `{spec['schema']}` version {spec['schema_version']}, "
        "with one array per field and the native sharding codec. Every array has the sample axis in front. `P` is the "
        "patch side in pixels and `C` the number of contour points, both in the data card.",
        "",
        "| field | on disk | shape | unit | scale | codecs | what |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, field in spec["fields"].items():
        shape = " x ".join(["n", *map(str, field["shape"])])
        scale = field.get("scale", "")
        scale = f"{scale:g}" if isinstance(scale, float) else scale
        scale = "squared" if field.get("squared") else scale
        cells = (f"`{name}`", field["dtype"], shape, field["unit"], scale, field["codec"], _cell(field["text"]))
        lines.append(f"| {' | '.join(cells)} |")
    lines += [
        "",
        "A stored integer times its scale is the value in the unit, and the root of a stored square is a distance: "
        "`posecore.shard.ShardReader` does both. All codecs are lossless. They are those of the Zarr v3 specification "
        "(`transpose`, called planes here, `zstd`, `blosc` with shuffle, `crc32c` after each chunk) and "
        "`numcodecs.delta`, which zarr-python brings along: "
        "`zarr.open_group(url)` reads every array as it is stored, with unit, scale and squared in its attributes. "
        "`depth_step_m` stands in the data card: 0.1 mm, doubled as often as the deepest scene of a very large object "
        "needs, halved until an object under 2 cm is 200 steps wide, as long as 16 bits reach the deepest scene.",
        "",
        "## The data card",
        "",
        "The group's attributes say how the dataset was made: schema and version, number of samples, shard size, patch "
        "side, contour points, step of depth, seed, the resolved configuration, the camera, each object with the hash "
        "of its file and its diameter, the versions of the software, and the units. The meshes lie beside it in "
        "`models/`, in BOP's layout (millimetres), so a dataset needs nothing else.",
        "",
        "## Complete or absent",
        "",
        "A shard is written under a temporary name, checksummed and renamed, and then gets its line in "
        "`manifest.jsonl`. A process killed at any moment loses at most the shards it was working on, and the same "
        "command goes on where it stopped. Sample *i* belongs to scene *i // hypotheses per scene*; training and "
        "validation are split by scene.",
        "",
    ]
    return "\n".join(lines)
