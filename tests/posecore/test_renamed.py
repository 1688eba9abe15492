"""Names of earlier versions: refused in imports, migrated in what is stored."""

import importlib
import json
import subprocess
import sys

import pytest
from posecore.bop import read_sidecar
from posecore.renamed import migrated_keys, refuse_renamed_modules

RENAMED = {
    "hypothesis.fresh": "hypothesis.online",
    "own_predictions": "on_policy",
    "own_predictions.share": "on_policy.fraction",
    "loss.target=overlap": "loss.target=visible_iou",
    "depth_scale": "camera.depth_scale",
}


def test_an_import_of_a_module_that_moved_names_its_new_place():
    refuse_renamed_modules({"posecore.compiled": "posecore.numba_jit"})
    with pytest.raises(ImportError, match=r"^posecore\.compiled is now posecore\.numba_jit$"):
        importlib.import_module("posecore.compiled")
    with pytest.raises(ModuleNotFoundError, match=r"No module named 'posecore\.nothing'"):
        importlib.import_module("posecore.nothing")
    finders = len(sys.meta_path)
    refuse_renamed_modules({"posecore.nothing": "posecore.something"})
    assert len(sys.meta_path) == finders
    with pytest.raises(ImportError, match=r"is now posecore\.something"):
        from posecore import nothing  # noqa: F401


def test_posecore_names_the_new_place_of_what_its_pages_showed():
    ended = subprocess.run([sys.executable, "-c", "import posecore.raster_reference"], capture_output=True, text=True)
    assert "ImportError: posecore.raster_reference is now posecore.raster.reference" in ended.stderr


REFUSALS = """
import importlib, pkgutil, sys
import evalkit, posecore, refinenet, synthgen
from posecore.renamed import _RenamedModules

table = next(finder for finder in sys.meta_path if isinstance(finder, _RenamedModules)).renamed
for old, new in table.items():
    for name in new.split(" and "):
        pkgutil.resolve_name(name)
    try:
        importlib.import_module(old)
    except ImportError as error:
        assert str(error) == f"{old} is now {new}", error
    else:
        raise AssertionError(old)
print(*sorted({old.partition(".")[0] for old in table}))
"""


@pytest.mark.slow
def test_every_module_that_is_refused_has_a_new_name_that_exists():
    ended = subprocess.run([sys.executable, "-c", REFUSALS], capture_output=True, text=True)
    assert ended.stdout == "evalkit posecore refinenet synthgen\n", ended.stderr


@pytest.mark.parametrize(
    ("stored", "expected"),
    [
        ({"hypothesis": {"a": 1, "fresh": True, "z": 2}}, {"hypothesis": {"a": 1, "online": True, "z": 2}}),
        ({"own_predictions": {"share": 0.5, "updates": 2}}, {"on_policy": {"updates": 2, "fraction": 0.5}}),
        ({"own_predictions": {"share": 0.5}, "n": 1}, {"on_policy": {"fraction": 0.5}, "n": 1}),
        ({"loss": {"target": "overlap"}}, {"loss": {"target": "visible_iou"}}),
        ({"loss": {"target": "other"}}, {"loss": {"target": "other"}}),
        ({"camera": {"fx": 1}, "depth_scale": 2}, {"camera": {"fx": 1, "depth_scale": 2}}),
        ({"depth_scale": 2}, {"camera": {"depth_scale": 2}}),
        ({"hypothesis": None, "loss": 3}, {"hypothesis": None, "loss": 3}),
        ({"on_policy": {"fraction": 0.1}, "own_predictions": {"share": 0.9}}, {"on_policy": {"fraction": 0.1}}),
        ({}, {}),
    ],
)
def test_stored_mappings_are_migrated(stored, expected):
    before = json.dumps(stored)
    assert migrated_keys(stored, RENAMED) == expected
    assert migrated_keys(expected, RENAMED) == expected
    assert json.dumps(stored) == before


def test_a_key_keeps_its_position():
    assert list(migrated_keys({"a": 1, "b": 2, "c": 3}, {"b": "x"})) == ["a", "x", "c"]


def test_sidecars_of_the_version_before_are_read_as_new_ones(tmp_path):
    stored = {"method": "start", "start_lines": [2, 3], "settings": {"sure": 0.5, "found": 0.2, "seed": 1}}
    (tmp_path / "r.csv.json").write_text(json.dumps(stored))
    assert read_sidecar(tmp_path / "r.csv") == {
        "method": "initial",
        "initial_lines": [2, 3],
        "settings": {"tracking_threshold": 0.5, "accept_threshold": 0.2, "seed": 1},
    }
