"""Configuration from YAML, and whole-file writes."""

import os
import stat
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import pytest
from posecore import config, files
from posecore.config import Range, check_ranges
from posecore.errors import ConfigError, MeshError, StorageError, exit_code


@dataclass(frozen=True, kw_only=True)
class Light:
    power_w: float = 1.0
    rgb: tuple[float, float, float] = (1.0, 1.0, 1.0)

    def __post_init__(self) -> None:
        if self.power_w < 0:
            raise ConfigError(f"power_w is {self.power_w}, expected 0 or more")


@dataclass(frozen=True, kw_only=True)
class Setup:
    n: int
    kind: Literal["a", "b"] = "a"
    light: Light = field(default_factory=Light)
    path: str | None = None
    widths: tuple[int, ...] = (1, 2)


def test_nested_build_and_back() -> None:
    setup = config.build(Setup, {"n": 3, "light": {"power_w": 2, "rgb": [1, 0, 0.5]}, "widths": [4]}, "x.yaml")
    assert setup == Setup(n=3, light=Light(power_w=2.0, rgb=(1.0, 0.0, 0.5)), widths=(4,))
    assert config.build(Setup, config.to_dict(setup), "again") == setup


@pytest.mark.parametrize(
    ("mapping", "message"),
    [
        ({"n": 1, "ligth": {}}, "x.yaml: unknown key ligth; known keys here: n, kind, light"),
        ({"n": 1, "light": {"powr": 1}}, "unknown key light.powr"),
        ({}, "the key n is missing"),
        ({"n": "many"}, "n is 'many', expected int"),
        ({"n": True}, "n is True, expected int"),
        ({"n": 1, "kind": "c"}, "kind is 'c', expected one of a, b"),
        ({"n": 1, "light": {"rgb": [1, 2]}}, r"light.rgb has 2 entries, expected 3"),
        ({"n": 1, "light": {"power_w": -1}}, "light.power_w is -1.0, expected 0 or more"),
        ({"n": 1, "light": 5}, "light is 5, expected a group"),
    ],
)
def test_wrong_keys_and_values_are_named(mapping: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        config.build(Setup, mapping, "x.yaml")
    assert exit_code(caught.value) == 2


@dataclass(frozen=True, kw_only=True)
class Ranged:
    n: Annotated[int, Range(1)] = 1
    fraction: Annotated[float, Range(0, 1)] = 0.5
    angle_deg: Annotated[float, Range(0, 180, above=True)] = 90.0
    decay: Annotated[float, Range(0, 1, under=True)] = 0.0
    scale: Annotated[float, Range(1, 5, unit="diameters")] | None = None
    shift: Annotated[float, Range(high=3)] = 0.0
    pair: Annotated[tuple[float, float], Range(-1, 1)] = (0.0, 0.5)
    maybe: Annotated[tuple[float, float] | None, Range(0, 1)] = None
    widths: tuple[Annotated[int, Range(1, unit="channels")], ...] = (1,)
    light: Light = field(default_factory=Light)

    def __post_init__(self) -> None:
        check_ranges(self)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"n": 0}, "n is 0, expected 1 or more"),
        ({"fraction": 1.5}, "fraction is 1.5, expected 0 to 1"),
        ({"fraction": float("nan")}, "fraction is nan, expected 0 to 1"),
        ({"shift": -float("inf")}, "shift is -inf, expected 3 or less"),
        ({"angle_deg": 0.0}, "angle_deg is 0.0, expected above 0 to 180"),
        ({"decay": 1.0}, "decay is 1.0, expected 0 to under 1"),
        ({"scale": 7.0}, "scale is 7.0, expected 1 to 5 diameters"),
        ({"pair": (0.5, 0.0)}, "pair is [0.5, 0.0], expected low <= high within -1 to 1"),
        ({"pair": (-2.0, 0.0)}, "pair is [-2.0, 0.0], expected low <= high within -1 to 1"),
        ({"maybe": (0.0, 1.5)}, "maybe is [0.0, 1.5], expected low <= high within 0 to 1"),
        ({"widths": (3, 0)}, "widths[1] is 0, expected 1 or more channels"),
    ],
)
def test_ranges_hold_for_files_and_for_code(values: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        Ranged(**values)
    assert str(caught.value) == message
    with pytest.raises(ConfigError) as caught:
        config.build(Ranged, values, "x.yaml")
    assert str(caught.value) == f"x.yaml: {message}"


def test_values_at_the_ends_of_their_ranges_are_fine() -> None:
    made = config.build(Ranged, {"fraction": 1, "angle_deg": 180, "scale": 5, "pair": [1, 1], "maybe": [0, 0]}, "x")
    assert (made.fraction, made.scale, made.pair, made.maybe) == (1.0, 5.0, (1.0, 1.0), (0.0, 0.0))


def test_build_checks_ranges_of_a_class_that_does_not() -> None:
    @dataclass(frozen=True, kw_only=True)
    class Careless:
        n: Annotated[int, Range(1)]

    assert Careless(n=0).n == 0
    with pytest.raises(ConfigError, match=r"x\.yaml: n is 0, expected 1 or more"):
        config.build(Careless, {"n": 0}, "x.yaml")


@pytest.mark.parametrize(
    ("mapping", "message"),
    [
        ({"light": {"watts": 2}}, "x.yaml: light.watts is now light.power_w"),
        ({"count": 2}, "x.yaml: count is now n"),
        ({"n": 1, "kind": "old"}, "x.yaml: kind=old is now kind=b"),
        ({"n": 1, "lamp": {"rgb": [1, 1, 1]}}, "x.yaml: lamp is now light"),
        ({"n": 1, "lamp": {"watts": 1}}, "x.yaml: lamp.watts is now light.power_w"),
    ],
)
def test_renamed_keys_are_refused_with_their_new_name(mapping: dict[str, object], message: str) -> None:
    renamed = {
        "lamp": "light", "count": "n", "light.watts": "light.power_w", "lamp.watts": "light.power_w",
        "kind=old": "kind=b",
    }  # fmt: skip
    with pytest.raises(ConfigError) as caught:
        config.build(Setup, mapping, "x.yaml", renamed)
    assert str(caught.value) == message
    assert config.build(Setup, {"n": 1, "kind": "b", "light": {"power_w": 1}}, "x.yaml", renamed).kind == "b"


def test_overrides_are_read_as_yaml() -> None:
    base = {"n": 1, "light": {"power_w": 1.0}}
    found = config.apply_overrides(base, ["light.power_w=3e-1", "kind=b", "widths=[8, 9]", "path=null"])
    assert config.build(Setup, found, "--set") == Setup(n=1, kind="b", light=Light(power_w=0.3), widths=(8, 9))
    assert base == {"n": 1, "light": {"power_w": 1.0}}
    for wrong in ("n", "=3", "n.x=1"):
        with pytest.raises(ConfigError, match="--set"):
            config.apply_overrides(base, [wrong])


def test_an_override_may_be_a_group_and_is_laid_over_what_is_there() -> None:
    base = {"n": 1, "light": {"power_w": 1.0, "rgb": [1, 1, 1]}}
    overrides = ["light={power_w: 2}", "kind=b", "camera={fx_px: 5, size: {w: 1, h: 2}}"]
    found = config.apply_overrides(base, overrides)
    assert found["light"] == {"power_w": 2, "rgb": [1, 1, 1]}
    assert found["camera"] == {"fx_px": 5, "size": {"w": 1, "h": 2}}
    keys = ["light.power_w", "kind", "camera.fx_px", "camera.size.w", "camera.size.h"]
    assert config.assigned_keys(overrides) == keys


def test_merge_lays_groups_over_groups() -> None:
    merged = config.merge({"n": 1, "light": {"power_w": 1, "rgb": [1, 1, 1]}}, {"light": {"power_w": 2}})
    assert merged == {"n": 1, "light": {"power_w": 2, "rgb": [1, 1, 1]}}


def test_yaml_errors_name_file_and_line(tmp_path: Path) -> None:
    file = tmp_path / "c.yaml"
    with pytest.raises(ConfigError, match=r"c.yaml: cannot be read"):
        config.load_yaml(file)
    file.write_text("a: 1\nb: [1, 2\n")
    with pytest.raises(ConfigError, match=r"c.yaml, line 3"):
        config.load_yaml(file)
    file.write_text("- 1\n")
    with pytest.raises(ConfigError, match="found a list"):
        config.load_yaml(file)


def test_atomic_write_replaces_and_leaves_nothing_behind(tmp_path: Path) -> None:
    file = tmp_path / "deep/er/f"
    files.write_atomic(file, b"one")
    files.write_atomic(file, b"two")
    assert file.read_bytes() == b"two"
    assert [p.name for p in file.parent.iterdir()] == ["f"]
    assert files.sha256_file(file) == files.sha256_bytes(b"two")


def test_a_file_in_the_way_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "f").write_text("x")
    with pytest.raises(StorageError, match="a file stands where a folder is needed"):
        files.write_atomic(tmp_path / "f/g", b"")


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_unwritable_folder_is_one_line(tmp_path: Path) -> None:
    tmp_path.chmod(stat.S_IRUSR | stat.S_IXUSR)
    with pytest.raises(StorageError, match="no permission"):
        files.write_atomic(tmp_path / "f", b"")


def test_full_disk_is_one_line_and_keeps_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    files.write_atomic(tmp_path / "f", b"old")

    def full(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(StorageError, match="disk is full"):
        files.write_atomic(tmp_path / "f", b"new")
    assert (tmp_path / "f").read_bytes() == b"old"
    assert len(list(tmp_path.iterdir())) == 1


def test_a_folder_in_the_way_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "poses.csv").mkdir()
    with pytest.raises(StorageError, match=r"poses.csv: a folder stands where a file is needed"):
        files.write_atomic(tmp_path / "poses.csv", b"x")
    assert [p.name for p in tmp_path.iterdir()] == ["poses.csv"]


def test_exit_codes() -> None:
    assert exit_code(MeshError("x")) == 1
    with pytest.raises(ConfigError, match="no such data specification"):
        files.data_spec("nothing.yaml")


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("[" * 100_000, "brackets are nested too deep|more than"),
        ("a: &a [1]\nb: &b [*a, *a, *a, *a, *a, *a, *a, *a]\n" + "\n".join(
            f"{chr(c + 1)}: &{chr(c + 1)} [{', '.join([f'*{chr(c)}'] * 8)}]" for c in range(ord("b"), ord("m"))
        ), "more than 100000 values, aliases counted each time"),
        ("a: &a\n  b: *a\n", "more than 100000 values, aliases counted each time|invalid YAML"),
        ("a: 2026-99-99", "invalid YAML"),
        ("a: \x07", "invalid YAML"),
        ("a: !!python/object:os.system {}", "invalid YAML"),
        ("a: [1", "invalid YAML"),
    ],
    ids=["brackets", "bomb", "circle", "date", "control character", "python", "cut"],
)  # fmt: skip
def test_yaml_that_is_none_or_has_no_end_is_one_line(tmp_path, text, line):
    file = tmp_path / "a.yaml"
    file.write_text(text)
    with pytest.raises(ConfigError, match=line) as caught:
        config.load_yaml(file)
    assert "\n" not in str(caught.value)
    assert str(caught.value).startswith(str(file))
    if "\n" not in text and len(text) < 100:
        with pytest.raises(ConfigError, match="--set "):
            config.apply_overrides({}, [f"x={text.removeprefix('a: ')}"])


def test_a_yaml_that_is_no_file_is_refused(tmp_path):
    os.mkfifo(tmp_path / "pipe.yaml")
    for file, reason in (
        (tmp_path / "pipe.yaml", "is a pipe"),
        ("/dev/zero", "is a device"),
        (tmp_path, "is a folder"),
    ):
        with pytest.raises(ConfigError, match=f"cannot be read \\({reason}, expected a regular file\\)"):
            config.load_yaml(file)
    (tmp_path / "large.yaml").write_bytes(b"#" * (1 << 20) + b"\n")
    with pytest.raises(ConfigError, match="has 1048577 bytes, expected at most 1048576"):
        config.load_yaml(tmp_path / "large.yaml")
