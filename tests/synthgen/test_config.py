import pytest
import yaml
from posecore import config as config_tools
from posecore.errors import ConfigError
from synthgen.config import RENAMED_KEYS, CutConfig, SynthConfig, load_config, load_cut_config, migrate, preset_names


def test_every_preset_resolves_and_survives_a_round_trip():
    assert {"default", "quickstart", "linemod", "tejani", "choi", "category", "tabletop"} <= set(preset_names())
    for name in preset_names():
        config = load_config(name)
        assert config_tools.build(SynthConfig, config_tools.to_dict(config), "again") == config


def test_priority_is_preset_then_set_then_option():
    config = load_config("default", ["samples=3", "window.padding=0.5"], {"samples": 5, "seed": None})
    assert (config.samples, config.window.padding, config.seed) == (5, 0.5, 0)
    assert config.patch_px == load_config("default").patch_px


def test_a_preset_file_is_read(tmp_path):
    file = tmp_path / "mine.yaml"
    file.write_text("patch_px: 96\ndistance: {unit: m, min: 0.4, max: 0.9}\n")
    config = load_config(str(file))
    assert (config.patch_px, config.distance.range_m(0.1)) == (96, (0.4, 0.9))


@pytest.mark.parametrize(
    ("overrides", "named"),
    [
        (["windw.padding=1"], "windw"),
        (["window.paddin=1"], "window.paddin"),
        (["distance.min=9", "distance.max=3"], r"distance.min is 9.0 and max is 3.0, expected min <= max"),
        (["material.textureless_fraction=0.6", "material.random_colour_fraction=0.5"], "expected a sum of at most 1"),
        (["lights.count=[3, 1]"], r"lights.count is \[3, 1\], expected low <= high within 0 to 16"),
        (["occluders.visible_fraction=[0.5, 1.1]"], r"visible_fraction is \[0.5, 1.1\]"),
        (["sensor.jpeg_quality=[0, 90]"], "within 1 to 100"),
        (["shard_size=10", "hypotheses_per_scene=4"], "shard_size"),
        (["engine=povray"], "engine"),
        (["patch_px=512"], "patch_px"),
        (["lights.count=[1]"], "lights.count"),
        (["perturbation.max_angle_deg=-3"], "max_angle_deg"),
    ],
)
def test_a_wrong_key_or_value_is_named(overrides, named):
    with pytest.raises(ConfigError, match=named):
        load_config("default", overrides)


@pytest.mark.parametrize(("old", "new"), RENAMED_KEYS.items())
def test_a_renamed_key_is_refused_with_its_new_name(old, new, tmp_path):
    group, key = old.split(".")
    with pytest.raises(ConfigError, match=rf"^--set: {old} is now {new}$"):
        load_config("default", [f"{old}=0.5"])
    (tmp_path / "mine.yaml").write_text(f"{group}: {{{key}: 0.5}}\n")
    with pytest.raises(ConfigError, match=rf"mine.yaml: {old} is now {new}$"):
        load_config(str(tmp_path / "mine.yaml"))


def test_a_renamed_key_of_cut_pairs_is_refused_with_its_new_name():
    with pytest.raises(ConfigError, match=r"--set: perturbation.easy_share is now perturbation.easy_fraction"):
        load_cut_config(["perturbation.easy_share=0.5"])
    assert load_cut_config(["scale=1.5"], {"padding": 0.4, "seed": None}) == CutConfig(scale=1.5, padding=0.4)


@pytest.mark.parametrize("config", [load_config("tabletop", ["sequence.min_period_s=3"]), CutConfig(padding=0.4)])
def test_a_stored_configuration_with_old_keys_is_migrated(config):
    stored = config_tools.to_dict(config)
    old_key = {new: old.partition(".")[2] for old, new in RENAMED_KEYS.items()}
    old = {
        group: {old_key.get(f"{group}.{key}", key): value for key, value in values.items()}
        if isinstance(values, dict)
        else values
        for group, values in stored.items()
    }
    assert "easy_share" in old["perturbation"]
    assert migrate(old) == stored
    assert list(migrate(old)["perturbation"]) == list(stored["perturbation"])
    assert migrate(stored) == stored
    assert config_tools.build(type(config), migrate(old), "card") == config


def test_an_unknown_preset_lists_the_known_ones():
    with pytest.raises(ConfigError, match="category, choi, default, linemod"):
        load_config("fast")


def test_distances_follow_the_object_or_are_absolute():
    near, far = load_config("default").distance.range_m(0.03)
    assert near == pytest.approx(0.12)
    assert far == pytest.approx(0.3)
    with pytest.raises(ConfigError, match=r"distance\.min"):
        load_config("default", ["distance.unit=m", "distance.min=0.05"]).distance.range_m(0.1)


def test_every_key_stands_in_the_documentation_with_its_default(repository):
    page = (repository / "docs" / "scene-keys.md").read_text(encoding="utf-8")
    config = config_tools.to_dict(SynthConfig())
    groups = {name: group for name, group in config.items() if isinstance(group, dict)}
    for name in groups.keys() - {"camera", "frames", "sequence"}:  # the last two are of whole images: docs/bop.md
        for key, value in groups[name].items():
            row = next((line for line in page.splitlines() if line.startswith(f"| `{name}.{key}` |")), None)
            assert row is not None, f"{name}.{key} is not in docs/scene-keys.md"
            assert yaml.safe_load(row.split("`")[3]) == value, row
    presets = (repository / "docs" / "scenes.md").read_text(encoding="utf-8")
    for preset in preset_names():
        assert f"| `{preset}` |" in presets
