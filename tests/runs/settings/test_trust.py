"""What settings may build."""

import importlib
import re
from pathlib import Path

import pytest
from omegaconf import OmegaConf
from run_folders import CONF, configure

from hdrqn_torchrl.cli.configuration import plain, resolved
from hdrqn_torchrl.envs.gym.arguments import PACKAGES
from hdrqn_torchrl.runs.settings.arguments import SettingsError, check_arguments
from hdrqn_torchrl.runs.settings.run_settings import check
from hdrqn_torchrl.runs.settings.trust import ALLOWED_TARGETS, KNOWN_PACKAGES, check_targets


@pytest.fixture
def settings():
    return configure()


class TestCheckTargets:
    def test_builders_named_in_conf_are_allowed(self):
        groups = ("env", "algo", "network", "logger", "experiment")
        files = [file for group in groups for file in (Path(CONF) / group).glob("*.yaml")]
        named = {name for file in files for name in re.findall(r"_target_: (\S+)", file.read_text())}
        assert named <= set(ALLOWED_TARGETS) and len(named) > 8

    @pytest.mark.parametrize("target", ALLOWED_TARGETS)
    def test_every_allowed_name_is_a_builder_of_this_package(self, target):
        module, _, name = target.rpartition(".")
        assert module.startswith("hdrqn_torchrl.") and callable(getattr(importlib.import_module(module), name))

    @pytest.mark.parametrize("target", ALLOWED_TARGETS)
    def test_every_builder_refuses_settings_that_it_does_not_take(self, target):
        module, _, name = target.rpartition(".")
        with pytest.raises(SettingsError, match=f"^part.misspelt must be left out, got 1: {target} takes "):
            check_arguments(
                {"_target_": target, "misspelt": 1}, "part", lambda _: getattr(importlib.import_module(module), name)
            )

    @pytest.mark.parametrize(
        ("key", "value", "path"),
        [
            ("env", {"_target_": "os.system", "command": "true"}, "env._target_"),
            ("algo.sub._target_", "hdrqn_torchrl.runs.persistence.checkpoint.os.system", "algo.sub._target_"),
            ("network.extra", {"deep": [1, [{"_target_": "posix.system"}]]}, "network.extra.deep[1][0]._target_"),
            ("logger.loggers", [{"_target_": "builtins.exec"}], "logger.loggers[0]._target_"),
            ("network._target_", 3, "network._target_"),
            ("network._target_", None, "network._target_"),
        ],
    )
    def test_other_builders_are_refused_by_their_path(self, settings, key, value, path):
        OmegaConf.update(settings, key, value, merge=False, force_add=True)
        with pytest.raises(
            SettingsError, match=f"^{re.escape(path)} must be one of the builders that .* trusts there, got "
        ):
            check_targets(plain(settings), [])

    def test_a_users_builders_can_be_added(self, settings):
        settings.env._target_ = "my_package.MyEnv"
        with pytest.raises(SettingsError, match=r"add 'allowed_targets=\[my_package\.Other,my_package\.MyEnv\]' to"):
            check_targets(plain(settings), ["my_package.Other"])
        check_targets(plain(settings), ["my_package.MyEnv"])
        settings.allowed_targets = ["my_package.MyEnv"]
        check(resolved(settings))


def test_packages_that_make_gym_knows_may_be_imported():
    assert set(KNOWN_PACKAGES) == set(PACKAGES.values())


def test_all_names_that_an_environment_imports_are_asked_for_at_once_with_those_that_are_allowed():
    env = {"_target_": "hdrqn_torchrl.envs.make_gym", "id": "Maze-v0", "subgoals": "mine.Doors", "package": "mazes"}
    with pytest.raises(
        SettingsError, match=r"got 'mine\.Doors', 'mazes'.*'allowed_targets=\[a\.B,mine\.Doors,mazes\]'"
    ):
        check_targets(env, ["a.B"], "env")
