"""Settings of a run and their rules."""

import re

import pytest
from omegaconf import OmegaConf
from run_folders import configure

from hdrqn_torchrl.cli.configuration import resolved
from hdrqn_torchrl.runs.settings.arguments import SettingsError
from hdrqn_torchrl.runs.settings.run_settings import as_plain, check, pick_device, settings_of


@pytest.fixture
def settings():
    return configure()


class TestCheck:
    def test_the_defaults_pass_the_check(self, settings):
        check(resolved(settings))

    @pytest.mark.parametrize(
        ("key", "value", "rule"),
        [
            ("total_frames", 0, ">= 1"),
            ("threads", 0, ">= 1"),
            ("steps_per_batch", 1, ">= 2"),
            ("log_frames", 0, ">= 1"),
            ("evaluation.num_envs", 0, ">= 1"),
            ("evaluation.episodes", -1, ">= 1"),
            ("evaluation.interval_frames", 0, ">= 1"),
            ("evaluation.final_episodes", 0, ">= 1"),
            ("checkpoint.interval_frames", 0, ">= 1"),
            ("checkpoint.keep_last", 1, ">= 2"),
            ("checkpoint.interval_minutes", 0.0, "> 0"),
            ("checkpoint.interval_minutes", -0.5, "> 0"),
            ("device", "tpu", "auto, cpu or cuda"),
        ],
    )
    def test_a_wrong_value_is_refused(self, settings, key, value, rule):
        OmegaConf.update(settings, key, value)
        with pytest.raises(SettingsError, match=rf"^{re.escape(key)} must be {rule}, got {value!r}; "):
            check(resolved(settings))

    @pytest.mark.parametrize("key", ["total_frams", "evaluation.episods", "checkpoint.keep_lst"])
    def test_an_unknown_key_is_refused(self, settings, key):
        OmegaConf.update(settings, key, 1, force_add=True)
        with pytest.raises(SettingsError, match=f"^{key.rpartition('.')[2]} must be a known setting; "):
            check(resolved(settings))


@pytest.mark.parametrize(
    ("name", "has_cuda", "device"), [("auto", True, "cuda"), ("auto", False, "cpu"), ("cpu", True, "cpu")]
)
def test_auto_picks_the_gpu_where_there_is_one(name, has_cuda, device):
    assert pick_device(name, has_cuda) == device


def test_cuda_without_a_gpu_is_refused():
    with pytest.raises(SettingsError, match="device must be cpu or auto on a machine without a usable GPU"):
        pick_device("cuda", has_cuda=False)


class TestSettingsOf:
    def test_settings_survive_the_way_through_plain_data(self, settings):
        found = resolved(settings)
        assert settings_of(as_plain(found)) == found

    @pytest.mark.parametrize(
        ("section", "key", "value", "told"),
        [
            ("evaluation", "episodes", "many", r"evaluation\.episodes must be an integer, got 'many'; "),
            (
                "checkpoint",
                "interval_minutes",
                None,
                r"checkpoint\.interval_minutes must be a finite number, got null",
            ),
            (None, "seed", 1.5, r"seed must be an integer, got 1\.5; "),
            (None, "allowed_targets", [3], r"allowed_targets must be a list of strings, got \[3\]; "),
            (None, "env", None, r"env must be settings by name, got null; "),
            (None, "evaluation", 3, r"evaluation must be settings by name, got 3; "),
        ],
    )
    def test_a_setting_of_another_type_is_refused(self, settings, section, key, value, told):
        data = as_plain(resolved(settings))
        (data if section is None else data[section])[key] = value
        with pytest.raises(SettingsError, match=f"^{told}"):
            settings_of(data)

    @pytest.mark.parametrize(("section", "key"), [(None, "seed"), ("evaluation", "seed"), (None, "checkpoint")])
    def test_a_missing_setting_is_named(self, settings, section, key):
        data = as_plain(resolved(settings))
        del (data if section is None else data[section])[key]
        name = key if section is None else rf"{section}\.{key}"
        with pytest.raises(SettingsError, match=f"^{name} must be given, got nothing; "):
            settings_of(data)
