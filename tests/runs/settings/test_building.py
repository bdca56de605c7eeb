"""What may be built, where, and how large."""

import pytest

from hdrqn_torchrl.runs.settings.arguments import SettingsError
from hdrqn_torchrl.runs.settings.building import build
from hdrqn_torchrl.runs.settings.trust import BUILDERS, check_sizes

GRID = {"_target_": "hdrqn_torchrl.envs.MultiGoalGridEnv"}
LEARNER = {"_target_": "hdrqn_torchrl.learning.LearnerSettings"}
V2 = {"_target_": "hdrqn_torchrl.algorithms.make_hdrqn"}
NET = {"_target_": "hdrqn_torchrl.modules.compact_network"}


@pytest.mark.parametrize(
    ("settings", "told"),
    [
        (GRID | {"num_envs": 10**9}, r"num_envs must be <= 100,000, got 1000000000; use less\."),
        (GRID | {"max_steps": 10**9}, r"max_steps must be <= 1,000,000, "),
        (V2 | {"prediction_steps": 10**9}, r"prediction_steps must be <= 64, "),
        (V2 | {"sub": LEARNER | {"capacity": 10**12}}, r"sub\.capacity must be <= 20,000,000, "),
        (NET | {"hidden_size": 10**5}, r"hidden_size must be <= 2,048, "),
        (NET | {"widths": [8, 10**5]}, r"widths must be <= 2,048, "),
        (NET | {"widths": [8] * 100}, r"widths must have at most 64 values, got 100\."),
        (LEARNER | {"warmup_frames": 10**400}, r"warmup_frames must be <= "),
        (LEARNER | {"warmup_frames": -(10**400)}, r"warmup_frames must be <= "),
    ],
    ids=lambda value: str(value)[:60],
)
def test_an_unreasonable_size_is_reported_with_its_rule(settings, told):
    with pytest.raises(SettingsError, match=f"^part\\.{told}") as refusal:
        check_sizes(settings, "part")
    assert str(refusal.value).endswith(".") and "\n" not in str(refusal.value)


def test_build_checks_types():
    with pytest.raises(ValueError, match=r"^env\.view must be an integer or null, got 'abc'; "):
        build(GRID | {"view": "abc"}, place="env")


@pytest.mark.parametrize("place", ["env", "network", "algo", "logger.loggers[0]"])
def test_a_builder_is_allowed_only_in_its_own_place(place):
    elsewhere = [
        target for name, targets in BUILDERS.items() if name.partition("[")[0] not in place for target in targets
    ]
    for target in elsewhere:
        with pytest.raises(SettingsError, match="must be one of the builders that this program trusts there"):
            build({"_target_": target}, place=place)


@pytest.mark.parametrize("settings", [None, 3, [], {}, {"num_envs": 3}, [GRID]], ids=str)
def test_settings_without_a_target_are_refused(settings):
    with pytest.raises(SettingsError, match=r"^env must be settings with a _target_, got "):
        build(settings, place="env")


def test_an_environment_is_built_from_its_settings():
    assert build(GRID | {"num_envs": 3, "view": None}, place="env").num_envs == 3


class TestMessages:
    def test_a_broken_rule_is_reported_with_the_full_name_of_the_setting(self):
        with pytest.raises(SettingsError, match=r"^env\.view must be an odd number .* got 4; "):
            build(GRID | {"view": 4}, place="env")

    def test_a_broken_rule_of_a_nested_part_is_reported_with_its_full_name(self):
        from helpers import compact_network, small_env

        settings = V2 | {"sub": LEARNER | {"batch_size": 0}}
        with pytest.raises(SettingsError, match=r"^algo\.sub\.batch_size must be >= 1, got 0; "):
            build(settings, small_env(2), compact_network(), place="algo")

    def test_an_unknown_setting_is_reported_with_those_that_its_builder_takes(self):
        told = r"^env\.veiw must be left out, got 4: .*MultiGoalGridEnv takes num_envs, .*view.*; '~env\.veiw' in"
        with pytest.raises(SettingsError, match=told):
            build(GRID | {"veiw": 4}, place="env")

    def test_a_setting_of_the_builder_that_another_one_replaced_is_refused(self):
        explores = {"_target_": "hdrqn_torchrl.modules.EpsilonGreedy", "start": 1.0, "exponent": 2.0}
        with pytest.raises(SettingsError, match=r"^algo\.sub_exploration\.exponent must be left out, got 2\.0: "):
            build(V2 | {"sub_exploration": explores}, None, None, place="algo")

    def test_an_error_of_the_machine_is_not_blamed_on_a_setting(self, tmp_path):
        (tmp_path / "file").write_text("")
        settings = {"_target_": "os.makedirs", "name": str(tmp_path / "file" / "folder")}
        with pytest.raises(SettingsError, match=r"^\[Errno \d+\] Not a directory: "):
            build(settings, place="env", allowed=["os.makedirs"])

    @pytest.mark.parametrize("target", ["no_such_package.Env", "hdrqn_torchrl.envs.NoSuchEnv", "hdrqn_torchrl.envs"])
    def test_a_target_that_can_not_be_called_is_refused(self, target):
        with pytest.raises(SettingsError, match=rf"^env\._target_ must name a function or class, got '{target}'"):
            build({"_target_": target}, place="env", allowed=[target])

    def test_a_missing_module_is_reported_with_how_to_name_its_folder(self):
        with pytest.raises(SettingsError, match=r"; install its package, or name the folder .* PYTHONPATH=FOLDER"):
            build({"_target_": "no_such_package.Env"}, place="env", allowed=["no_such_package.Env"])


def test_settings_that_a_logger_only_shows_are_not_built():
    settings = {"_target_": "builtins.dict", "settings": {"env": dict(GRID)}, "_recursive_": False, "_convert_": "all"}
    found = build(settings, place="logger.loggers[0]", allowed=["builtins.dict"])
    assert found == {"settings": {"env": GRID}} and found["settings"] is not settings["settings"]


@pytest.mark.parametrize("mark", [{"_partial_": True}, {"_args_": [3]}, {"_recursive_": True}], ids=str)
def test_other_special_keys_of_hydra_are_refused(mark):
    with pytest.raises(SettingsError, match=rf"^env\.{next(iter(mark))} must be left out, got "):
        build({"_target_": "builtins.dict"} | mark, place="env", allowed=["builtins.dict"])
