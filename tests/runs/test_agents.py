"""Trained agents loaded from run folders, honest or hostile."""

import subprocess
import sys

import pytest
from omegaconf import OmegaConf
from processes import ROOT
from run_folders import HOSTILE, changed, write_run

from hdrqn_torchrl.cli.configuration import resolved
from hdrqn_torchrl.runs import load_agent
from hdrqn_torchrl.runs.settings import building
from hdrqn_torchrl.runs.settings.arguments import SettingsError
from hdrqn_torchrl.runs.settings.building import build_algorithm


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run folder with two checkpoints: the older one is the best."""
    folder = tmp_path_factory.mktemp("outputs") / "run"
    folder.mkdir()
    write_run(folder)
    return folder


def step_of(agent):
    return agent.algorithm.policy.sub_controller.network.head.streams.bias[0].item()


WITHOUT_HYDRA = """
import sys
from importlib.machinery import PathFinder

find, hidden = PathFinder.find_spec, ("hydra", "omegaconf")
PathFinder.find_spec = lambda name, *rest: None if name in hidden else find(name, *rest)
import hdrqn_torchrl.runs
assert "torch" not in sys.modules
from hdrqn_torchrl.runs import load_agent

agent = load_agent(sys.argv[1], num_envs=2)
print(tuple(agent.env.rollout(3, agent.algorithm.policy, break_when_any_done=False).shape))
"""


def test_neither_hydra_nor_omegaconf_is_needed(run):
    command = [sys.executable, "-c", WITHOUT_HYDRA, str(run)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert done.stdout == "(2, 3)\n", done.stderr


class TestLoadAgent:
    def test_a_loaded_agent_plays_its_task(self, run):
        agent = load_agent(run, num_envs=3)
        rollout = agent.env.rollout(5, agent.algorithm.policy, break_when_any_done=False)
        assert rollout.shape == (3, 5) and agent.config.env["view"] == 3 and rollout["observation"].shape[2:] == (3, 3)

    @pytest.mark.parametrize(("checkpoint", "step"), [("best", 100), ("last", 200)])
    def test_an_agent_has_the_best_or_the_last_weights(self, run, checkpoint, step):
        agent = load_agent(run, checkpoint=checkpoint)
        assert step_of(agent) == agent.frames == step

    def test_an_agent_has_the_weights_of_a_path(self, run):
        assert step_of(load_agent(run)) == 100
        agent = load_agent(str(run), checkpoint=str(run / "checkpoints" / "checkpoint-000000000200"))
        assert step_of(agent) == agent.frames == 200
        agent = load_agent(run, checkpoint=str(run / "weights.safetensors"))
        assert step_of(agent) == 200 and agent.frames is None

    def test_the_task_of_an_agent_can_be_changed(self, run):
        agent = load_agent(run, env_changes={"layout": "four_rooms", "max_steps": 3})
        assert agent.env.base_env.max_steps == 3 and agent.config.env["layout"] == "four_rooms"

    @pytest.mark.parametrize("key", ["veiw", "_target_", "_partial_"])
    def test_a_change_of_an_unknown_setting_is_refused(self, run, key):
        with pytest.raises(SettingsError, match=rf"env\.KEY must be one of \['layout', .*\], got {key}\."):
            load_agent(run, env_changes={key: 3})

    def test_a_change_that_the_weights_do_not_fit_is_refused(self, run):
        with pytest.raises(
            SettingsError,
            match=r"env.num_goals=3 must not change what the agent's networks see or choose from, but",
        ):
            load_agent(run, env_changes={"num_goals": 3})

    def test_a_change_that_breaks_a_rule_is_refused(self, run):
        with pytest.raises(SettingsError, match=r"^env\.max_steps must be >= 1, got 0; "):
            load_agent(run, env_changes={"max_steps": 0})

    def test_a_folder_that_is_not_a_run_is_refused(self, run, tmp_path):
        for folder in (tmp_path, tmp_path / "nothing", run / "config.yaml"):
            with pytest.raises(SettingsError, match=r"^run must be the folder of a training, got .* no config\.yaml; "):
                load_agent(folder)

    def test_a_run_without_checkpoints_is_refused(self, tmp_path):
        write_run(tmp_path, weights=False)
        with pytest.raises(SettingsError, match=r"checkpoint=best is not in .*: the run has not saved anything yet"):
            load_agent(tmp_path)

    @pytest.mark.parametrize("checkpoint", ["best", "last"])
    def test_a_run_whose_checkpoints_are_all_damaged_is_refused(self, tmp_path, checkpoint):
        write_run(tmp_path)
        for manifest in tmp_path.rglob("manifest.json"):
            manifest.write_text("[]")
        with (
            pytest.warns(UserWarning, match="is damaged: manifest"),
            pytest.raises(SettingsError, match="can't be loaded"),
        ):
            load_agent(tmp_path, checkpoint=checkpoint)

    def test_a_file_in_place_of_the_checkpoints_is_refused(self, tmp_path):
        write_run(tmp_path, weights=False)
        (tmp_path / "checkpoints").write_text("")
        with pytest.raises(SettingsError, match="checkpoints must be what a run leaves there, got a file;"):
            load_agent(tmp_path)


@pytest.fixture
def hostile_run(tmp_path, monkeypatch):
    """Writes a run folder; afterwards nothing may have been executed."""
    monkeypatch.setenv("HOSTILE_TARGET", "os.makedirs")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "run").mkdir()

    def write(text, *, weights=False):
        write_run(tmp_path / "run", text.replace("MARKER", str(tmp_path / "marker")), weights=weights)
        return tmp_path / "run"

    yield write
    assert not (tmp_path / "marker").exists()


class TestHostileRunFolders:
    def test_the_data_that_is_checked_is_the_data_that_is_built(self, hostile_run):
        """Hydra follows references when it builds: this name is harmless before the device is set, and not after."""
        config = OmegaConf.create(HOSTILE["name that changes with the device"]())
        config.env.name = str(hostile_run(changed()) / "marker")
        harmless = resolved(config)
        assert harmless.env["_target_"] == "hdrqn_torchrl.envs.MultiGoalGridEnv"
        config.env.device = "cpu"
        assert resolved(config).env["_target_"] == "os.makedirs"
        with pytest.raises(SettingsError, match=r"env\._target_ must be one of .* got 'os\.makedirs'"):
            build_algorithm(resolved(config))
        with pytest.raises(SettingsError, match=r"env\.t must be left out"):
            build_algorithm(harmless, {"device": "cpu"})

    def test_the_hostile_folder_would_run_code_without_the_check(self, tmp_path, monkeypatch):
        """So that the other tests prove something."""
        monkeypatch.setattr(building, "check_targets", lambda *_: None)
        kinds = ("a part of a part", "in place of a number", "through a module of the package")
        for number, kind in enumerate([*kinds, "allowed by itself, in part"]):
            write_run(tmp_path, HOSTILE[kind]().replace("MARKER", str(tmp_path / str(number))), weights=False)
            with pytest.raises((SettingsError, AttributeError)):
                load_agent(tmp_path)
            assert (tmp_path / str(number)).exists(), kind

    @pytest.mark.parametrize("kind", HOSTILE)
    def test_nothing_is_executed_and_a_message_says_why(self, hostile_run, kind):
        run = hostile_run(HOSTILE[kind]())
        with pytest.raises(SettingsError) as refusal:
            load_agent(run)
        assert len(str(refusal.value)) > 20 and str(refusal.value).count("\n") < 3

    def test_a_builder_that_the_caller_allows_is_called(self, hostile_run):
        run = hostile_run(changed(network={"_target_": "hdrqn_torchrl.modules.Architecture"}))
        with pytest.raises(SettingsError, match=r"allowed_targets=\[hdrqn_torchrl\.modules\.Architecture\]"):
            load_agent(run)
        with pytest.raises(SettingsError, match=r"network: .*missing"):
            load_agent(run, allowed_targets=["hdrqn_torchrl.modules.Architecture"])
