"""The workspace keeps its promises: who imports whom, declared dependencies, documented commands, shipped files."""

import ast
import importlib.util
import re
import sys
import tomllib
from collections.abc import Iterator
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import click
import pytest
from posecore.shard import field_table

REPOSITORY = Path(__file__).resolve().parent.parent
PACKAGES = ("posecore", "synthgen", "refinenet", "evalkit")
PROGRAMS = ("synthgen", "refinenet", "evalkit")
DISTRIBUTIONS = {  # module -> the name it is installed under, where the two differ
    "cv2": "opencv-python-headless",
    "google_crc32c": "google-crc32c",
    "huggingface_hub": "huggingface-hub",
    "mapbox_earcut": "mapbox-earcut",
    "mathutils": "bpy",
    "PIL": "pillow",
    "yaml": "pyyaml",
}
WANTED_UNSEEN = {  # declared though no line imports them
    "bpy",  # imported inside synthgen/engines/blender only, some of it as mathutils
    "dask",  # distributed needs one of its own age
    "tensorboard",  # torch.utils.tensorboard writes with it
    "s3fs",  # fsspec opens s3:// with it
    "onnx",
    "onnxscript",  # torch.onnx.export translates with them
    "cryptography",  # what dask makes the certificates of local workers with
    "bokeh",  # what dask draws its dashboard with
    "zarr",  # what others open a dataset with; tests hold our shard files against it
}
TEST_TIME_ORACLES = {"timm"}
ORDER = {  # folders and top-level modules of a package in the order of its work: none imports one that comes later
    "posecore": (
        "errors text schema renamed se3 srgb files image_file config processes numba_jit kernels ply mesh_files "
        "symmetry diameter mesh detail simplify window camera contour raster store shard bop html command_line"
    ),
    "synthgen": "names scene engine machine lock config image inputs engines draw pairs bop run inspect verify cli",
    "refinenet": (
        "renamed errors device batch refiner config geometry image models data training baselines refine tracking cli "
        "__main__"
    ),
    "evalkit": (
        "error_table inputs pose_errors scores evaluation tables report diff check tracking cli"
    ),
}  # fmt: skip


def sources(package: str) -> list[Path]:
    return sorted((REPOSITORY / "packages" / package / "src" / package).rglob("*.py"))


def imports(file: Path) -> Iterator[tuple[str, int]]:
    """Top-level module names that a file imports anywhere, also inside functions, with their lines."""
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"), str(file))):
        if isinstance(node, ast.Import):
            yield from ((alias.name.split(".")[0], node.lineno) for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
            yield node.module.split(".")[0], node.lineno


def offences(package: str, banned: set[str], outside: str = "") -> list[str]:
    found = []
    for file in sources(package):
        place = file.relative_to(REPOSITORY).as_posix()
        if outside and f"/{outside}/" in place:
            continue
        found += [f"{place}:{line} imports {name}" for name, line in imports(file) if name in banned]
    return found


@pytest.mark.parametrize("package", PACKAGES)
def test_every_package_has_sources(package: str) -> None:
    assert sources(package)


@pytest.mark.parametrize("package", PROGRAMS)
def test_programs_never_import_each_other(package: str) -> None:
    assert offences(package, set(PROGRAMS) - {package}) == []


def test_posecore_stands_on_its_own() -> None:
    assert offences("posecore", {"torch", "bpy", "mathutils", *PROGRAMS}) == []
    with_extra = {"packages/posecore/src/posecore/command_line.py"}
    assert {line.partition(":")[0] for line in offences("posecore", {"click", "rich"})} == with_extra
    users = [file for file in sources("posecore") if "command_line" in file.read_text()]
    assert users == []


@pytest.mark.slow
def test_blender_stays_in_one_folder() -> None:
    found = offences("synthgen", {"bpy", "mathutils"}, outside="synthgen/engines/blender")
    found += [line for package in PACKAGES if package != "synthgen" for line in offences(package, {"bpy", "mathutils"})]
    assert found == []


def test_torch_stays_in_refinenet() -> None:
    assert [line for package in PACKAGES if package != "refinenet" for line in offences(package, {"torch"})] == []


@pytest.mark.parametrize("package", PACKAGES)
def test_imports_are_declared_dependencies(package: str) -> None:
    project = tomllib.loads((REPOSITORY / "packages" / package / "pyproject.toml").read_text())["project"]
    extras = [name for group in project.get("optional-dependencies", {}).values() for name in group]
    declared = {normal(re.split(r"[\s<>=!~;\[]", name)[0]) for name in [*project["dependencies"], *extras]}
    used = {name for file in sources(package) for name, _ in imports(file)} - set(sys.stdlib_module_names)
    used -= {package, *TEST_TIME_ORACLES}
    undeclared = {name for name in used if normal(DISTRIBUTIONS.get(name, name)) not in declared}
    assert undeclared == set()
    unused = declared - {normal(DISTRIBUTIONS.get(name, name)) for name in used}
    assert unused - WANTED_UNSEEN == set()


def normal(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


@pytest.mark.slow
@pytest.mark.parametrize("package", PACKAGES)
def test_no_print_in_packages(package: str) -> None:
    found = []
    for file in sources(package):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "print":
                found.append(f"{file.relative_to(REPOSITORY)}:{node.lineno}")
    assert found == []


@pytest.mark.parametrize("package", PACKAGES)
def test_package_ships_licence_readme_and_the_common_version(package: str) -> None:
    folder = REPOSITORY / "packages" / package
    project = tomllib.loads((folder / "pyproject.toml").read_text())["project"]
    licence = "GPL-3.0-or-later" if package == "synthgen" else "Apache-2.0"
    assert project["license"] == licence
    assert ("GENERAL PUBLIC LICENSE" if package == "synthgen" else "Apache License") in (folder / "LICENSE").read_text()
    assert (folder / project["readme"]).read_text().startswith(f"# {package}")
    versions = {
        tomllib.loads((REPOSITORY / "packages" / p / "pyproject.toml").read_text())["project"]["version"]
        for p in PACKAGES
    }
    assert versions == {project["version"]}
    own = [name for name in project["dependencies"] if name.startswith("posecore")]
    assert own == ([] if package == "posecore" else [f"posecore[cli]=={project['version']}"])


def module_name(file: Path, package: str) -> str:
    inner = file.relative_to(REPOSITORY / "packages" / package / "src").with_suffix("")
    return ".".join(inner.parts).removesuffix(".__init__")


def own_imports(file: Path, package: str) -> Iterator[tuple[str, int]]:
    """Modules of its own package that a file imports anywhere, with their lines."""
    modules = {module_name(source, package) for source in sources(package)}
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] == package:
            for alias in node.names:
                inner = f"{node.module}.{alias.name}"
                yield inner if inner in modules else node.module, node.lineno
        elif isinstance(node, ast.Import):
            yield from ((alias.name, node.lineno) for alias in node.names if alias.name.split(".")[0] == package)


@pytest.mark.parametrize("package", PACKAGES)
def test_no_import_runs_upward(package: str) -> None:
    """The folders of a package read from top to bottom in the order of its work."""
    rank = {name: index for index, name in enumerate(ORDER[package].split())}
    upward = []
    for file in sources(package):
        parts = module_name(file, package).split(".")
        if len(parts) == 1:  # the public face may hand on from anywhere
            continue
        for module, line in own_imports(file, package):
            target = module.split(".")[1:2]
            if target and rank[target[0]] > rank[parts[1]]:
                upward.append(f"{file.relative_to(REPOSITORY)}:{line} imports {module}")
    assert upward == []


@pytest.mark.parametrize("package", PACKAGES)
def test_no_modules_import_each_other_in_a_circle(package: str) -> None:
    graph = {
        module_name(file, package): {module for module, _ in own_imports(file, package)} for file in sources(package)
    }
    faces = {module_name(file, package) for file in sources(package) if file.name == "__init__.py"}
    graph = {module: imported - {package} - (faces & set(parents(module))) for module, imported in graph.items()}
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        pytest.fail(f"modules import each other in a circle: {' -> '.join(error.args[1])}")


def parents(module: str) -> list[str]:
    parts = module.split(".")
    return [".".join(parts[:length]) for length in range(1, len(parts))]


def test_data_specs_are_one_folder() -> None:
    installed = REPOSITORY / "packages" / "posecore" / "src" / "posecore" / "data_specs"
    assert installed.resolve() == REPOSITORY / "data_specs"
    assert (installed / "shard_fields.yaml").is_file()


# ---------------------------------------------------------------- commands


@cache
def hooks():
    spec = importlib.util.spec_from_file_location("docs_hooks", REPOSITORY / "docs" / "hooks.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def every_command() -> list[tuple[str, click.Command]]:
    return [pair for program in PROGRAMS for pair in hooks().commands(program)]


@pytest.mark.parametrize("program", PROGRAMS)
def test_every_command_has_help_with_an_example(program: str) -> None:
    for name, command in hooks().commands(program):
        text = command.help or ""
        assert text.strip(), f"{name} has no help"
        assert f"{program} " in text, f"{name} --help shows no example of a call"
        assert "\\b" not in text, f"{name}: click's \\b has to be a backspace, so its docstring cannot be raw"
        for parameter in command.params:
            if isinstance(parameter, click.Option) and not parameter.hidden:
                assert parameter.help, f"{name} {parameter.opts[0]} has no help"


def test_every_command_and_option_is_documented() -> None:
    page = hooks().cli_page()
    headings = set(re.findall(r"^#+ (.+)$", page, re.MULTILINE))
    for name, command in every_command():
        assert name in headings
        section = re.split(rf"^#+ {re.escape(name)}$", page, flags=re.MULTILINE)[1]
        section = re.split(r"^#", section, flags=re.MULTILINE)[0]
        for parameter in command.params:
            if isinstance(parameter, click.Option) and not parameter.hidden:
                assert parameter.opts[-1] in section, f"{name} {parameter.opts[-1]}"


def test_every_shard_field_is_documented() -> None:
    page = hooks().data_format_page()
    assert field_table()
    for field in field_table():
        row = next(line for line in page.splitlines() if line.startswith(f"| `{field.name}` |"))
        assert f"| {field.dtype} |" in row
        assert f"| {field.unit} |" in row


def test_written_commands_exist() -> None:
    """Commands in the README and the hand-written pages are commands that exist."""
    known = {name for name, _ in every_command()}
    pages = [REPOSITORY / "README.md", *(REPOSITORY / "docs").rglob("*.md"), *REPOSITORY.glob("packages/*/README.md")]
    for page in pages:
        for call in re.findall(rf"^(?:    |`)?((?:{'|'.join(PROGRAMS)}) [a-z][a-z-]+)", page.read_text(), re.MULTILINE):
            assert call in known, f"{page.relative_to(REPOSITORY)} shows `{call}`"
