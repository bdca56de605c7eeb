"""Settings: their rules, what they may build, and run folders that mean harm."""

import importlib
import json
import re
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import torch
from hydra import compose, initialize_config_dir
from hydra.errors import InstantiationException
from hydra.utils import instantiate
from omegaconf import MISSING, OmegaConf

from hdrqn_torchrl.cli import building, configuration
from hdrqn_torchrl.cli.building import ALLOWED_TARGETS, build_algorithm, check_targets, explain, plain
from hdrqn_torchrl.cli.configuration import (
    SettingsError,
    check,
    command_line,
    load_agent,
    pick_device,
    read_choices,
    read_config,
    resolved,
)
from hdrqn_torchrl.runs.checkpoint import Checkpoints, save_weights

CONF = str(configuration.CONF)
SMALL = ("network.hidden_size=8", "network.widths=[8]", "env.view=3", "env.num_envs=4", "algo.sub.batch_size=4")


@cache
def composed():
    with initialize_config_dir(CONF, version_base="1.3"):
        return compose("config", overrides=list(SMALL))


def configure():
    """A valid configuration."""
    return composed().copy()


@pytest.fixture
def settings():
    return configure()


class TestCheck:
    def test_the_defaults_are_right(self, settings):
        check(settings)

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
    def test_a_wrong_value(self, settings, key, value, rule):
        OmegaConf.update(settings, key, value)
        with pytest.raises(SettingsError, match=rf"^{re.escape(key)} must be {rule}, got {value!r}; "):
            check(settings)

    @pytest.mark.parametrize("key", ["total_frams", "evaluation.episods", "checkpoint.keep_lst"])
    def test_an_unknown_key(self, settings, key):
        OmegaConf.update(settings, key, 1, force_add=True)
        with pytest.raises(SettingsError, match=f"^{key.rpartition('.')[2]} must be a known setting; "):
            check(settings)


@pytest.mark.parametrize(
    ("name", "has_cuda", "device"), [("auto", True, "cuda"), ("auto", False, "cpu"), ("cpu", True, "cpu")]
)
def test_pick_device(name, has_cuda, device):
    assert pick_device(name, has_cuda) == device


def test_a_gpu_that_is_not_there():
    with pytest.raises(SettingsError, match="device must be cpu or auto on a machine without a usable GPU"):
        pick_device("cuda", has_cuda=False)


class TestCheckTargets:
    def test_what_the_files_of_conf_name_is_allowed(self):
        groups = ("env", "algo", "network", "logger", "experiment")
        files = [file for group in groups for file in (Path(CONF) / group).glob("*.yaml")]
        named = {name for file in files for name in re.findall(r"_target_: (\S+)", file.read_text())}
        assert named <= set(ALLOWED_TARGETS) and len(named) > 8

    @pytest.mark.parametrize("target", ALLOWED_TARGETS)
    def test_every_allowed_name_is_a_builder_of_this_package(self, target):
        module, _, name = target.rpartition(".")
        assert module.startswith("hdrqn_torchrl.") and callable(getattr(importlib.import_module(module), name))

    @pytest.mark.parametrize(
        ("key", "value", "path"),
        [
            ("env", {"_target_": "os.system", "command": "true"}, "env._target_"),
            ("algo.sub._target_", "hdrqn_torchrl.runs.checkpoint.os.system", "algo.sub._target_"),
            ("network.extra", {"deep": [1, [{"_target_": "posix.system"}]]}, "network.extra.deep[1][0]._target_"),
            ("logger.loggers", [{"_target_": "builtins.exec"}], "logger.loggers[0]._target_"),
            ("network._target_", 3, "network._target_"),
            ("network._target_", None, "network._target_"),
        ],
    )
    def test_all_others_are_refused_by_their_place(self, settings, key, value, path):
        OmegaConf.update(settings, key, value, merge=False, force_add=True)
        with pytest.raises(
            SettingsError, match=f"^{re.escape(path)} must be one of the builders that .* trusts there, got "
        ):
            check_targets(plain(settings), [])

    def test_ones_own_builders_can_be_added(self, settings):
        settings.env._target_ = "my_package.MyEnv"
        with pytest.raises(SettingsError, match=r"add 'allowed_targets=\[my_package\.MyEnv\]' to the command"):
            check_targets(plain(settings), ["my_package.Other"])
        check_targets(plain(settings), ["my_package.MyEnv"])
        settings.allowed_targets = ["my_package.MyEnv"]
        check(settings)


@pytest.mark.parametrize("name", ["drqn", "v1", "v2", "v3"])
def test_one_precision_for_all_learners(name):
    small = ["env.num_envs=4", "network.hidden_size=8", "network.widths=[8]"]
    with initialize_config_dir(CONF, version_base="1.3"):
        config = compose("config", overrides=[f"algo={name}", "precision=fp32", *small])
        wrong = compose("config", overrides=[f"algo={name}", "precision=fp16", *small])
    _, algorithm = build_algorithm(config)
    assert {learner.settings.precision for learner in algorithm.learners.values()} == {"fp32"}
    with pytest.raises(ValueError, match=r"precision must be one of 'fp32', 'bf16', 'auto', got 'fp16'; "):
        build_algorithm(wrong)


@pytest.mark.parametrize(
    ("chosen", "fine"),
    [
        (["env=gridworld", "algo=v3"], -0.5),  # where goals have an order
        (["env=four_rooms", "algo=v3"], -0.5),
        (["env=nine_rooms", "algo=v3"], -0.5),
        (["variant=v3"], -0.5),
        (["variant=v3_free_passage"], 0.0),
        (["env=gridworld", "algo=v3", "algo.wrong_subgoal_reward=-0.25"], -0.25),
        (["env=montezuma", "algo=v3"], 0.0),
        (["env=gridworld", "algo=v2"], 0.0),
    ],
    ids=str,
)
def test_what_another_subgoal_costs(chosen, fine):
    with initialize_config_dir(CONF, version_base="1.3"):
        assert compose("config", overrides=chosen).algo.wrong_subgoal_reward == fine


VARIANTS = sorted(path.stem for path in (Path(CONF) / "variant").glob("*.yaml"))


class TestVariants:
    @pytest.mark.parametrize("name", VARIANTS)
    def test_each_can_be_built_and_differs_from_its_algorithm(self, name):
        small = ["env.num_envs=4", "network.hidden_size=8", "network.widths=[8]"]
        with initialize_config_dir(CONF, version_base="1.3"):
            config = compose("config", overrides=[f"variant={name}", *small])
            plain = compose("config", overrides=[f"algo={name.split('_')[0]}", *small])
        check(config)
        build_algorithm(config)
        assert ((config.algo, config.env) != (plain.algo, plain.env)) == ("_" in name)

    def test_each_stands_in_an_experiment(self):
        used = set()
        for name in ("ablation", "authors_choices"):
            sweep = OmegaConf.load(Path(CONF) / "experiment" / f"{name}.yaml").hydra.sweeper.params
            used |= set(sweep.variant.split(","))
        assert sorted(used) == VARIANTS


@pytest.mark.parametrize(
    ("section", "told"),
    [
        (
            {"_target_": "hdrqn_torchrl.envs.MultiGoalGridEnv", "view": 4},
            r"env\.view must be an odd number .* got 4; .*",
        ),
        (
            {"_target_": "hdrqn_torchrl.envs.MultiGoalGridEnv", "veiw": 4},
            r"env: .*'veiw'; `python train\.py --cfg job` .*",
        ),
        ({"_target_": "os.makedirs", "name": "FILE/folder"}, r"\[Errno \d+\] Not a directory: .*"),  # no wrong setting
    ],
    ids=["value", "name", "disk"],
)
def test_explain(settings, tmp_path, section, told):
    (tmp_path / "FILE").write_text("")
    settings.env = {key: str(value).replace("FILE", str(tmp_path / "FILE")) for key, value in section.items()}
    if "view" in section:
        settings.env.view = 4
    with pytest.raises(InstantiationException) as error:
        instantiate(settings.env)
    assert re.fullmatch(told, explain(error.value))
    assert explain(ValueError("seed must be an integer.")) == "seed must be an integer."


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run folder with two checkpoints: the older one is the best."""
    folder = tmp_path_factory.mktemp("outputs") / "run"
    folder.mkdir()
    write_run(folder)
    return folder


def write_run(folder, text=None, *, weights=True):
    config = configure()
    (folder / "config.yaml").write_text(OmegaConf.to_yaml(config) if text is None else text)
    (folder / "run.json").write_text(json.dumps({"choices": {"env": "gridworld", "algo": "v2"}}))
    if not weights:
        return
    torch.manual_seed(0)
    _, algorithm = build_algorithm(config)
    checkpoints = Checkpoints(folder / "checkpoints")
    for step, score in ((100, 0.5), (200, None)):
        with torch.no_grad():
            algorithm.policy.sub_controller.network.head.streams.bias.fill_(step)
        checkpoints.save({"policy": algorithm.policy, "rest": torch.nn.Linear(1, 1)}, step=step, score=score)
    save_weights(algorithm.policy, folder / "weights.safetensors")


def step_of(agent):
    return agent.algorithm.policy.sub_controller.network.head.streams.bias[0].item()


class TestLoadAgent:
    def test_the_agent_plays_its_task(self, run):
        agent = load_agent(run, num_envs=3)
        rollout = agent.env.rollout(5, agent.algorithm.policy, break_when_any_done=False)
        assert rollout.shape == (3, 5) and agent.config.env.view == 3 and rollout["observation"].shape[2:] == (3, 3)

    @pytest.mark.parametrize(("checkpoint", "step"), [("best", 100), ("last", 200)])
    def test_its_weights_are_the_best_or_the_last(self, run, checkpoint, step):
        assert step_of(load_agent(run, checkpoint=checkpoint)) == step

    def test_or_those_of_a_path(self, run):
        assert step_of(load_agent(run)) == 100
        assert step_of(load_agent(str(run), checkpoint=str(run / "checkpoints" / "checkpoint-000000000200"))) == 200
        assert step_of(load_agent(run, checkpoint=str(run / "weights.safetensors"))) == 200

    def test_its_task_can_be_changed(self, run):
        agent = load_agent(run, env_changes={"layout": "four_rooms", "max_steps": 3})
        assert agent.env.base_env.max_steps == 3 and agent.config.env.layout == "four_rooms"

    @pytest.mark.parametrize("key", ["veiw", "_target_", "_partial_"])
    def test_but_not_by_what_is_no_setting_of_it(self, run, key):
        with pytest.raises(SettingsError, match=rf"env\.{key} must be one of \['layout', .*\]; it is none"):
            load_agent(run, env_changes={key: 3})

    def test_a_change_that_its_weights_do_not_fit(self, run):
        with pytest.raises(
            SettingsError,
            match=r"env.num_goals=3 must leave what the agent sees and does as its networks were made for, but",
        ):
            load_agent(run, env_changes={"num_goals": 3})

    def test_a_change_that_breaks_a_rule(self, run):
        with pytest.raises(SettingsError, match=r"^env\.max_steps must be >= 1, got 0; "):
            load_agent(run, env_changes={"max_steps": 0})

    def test_what_is_no_run(self, run, tmp_path):
        for folder in (tmp_path, tmp_path / "nothing", run / "config.yaml"):
            with pytest.raises(SettingsError, match=r"^run must be the folder of a training, got .* no config\.yaml; "):
                load_agent(folder)

    def test_a_run_that_has_saved_nothing(self, tmp_path):
        write_run(tmp_path, weights=False)
        with pytest.raises(SettingsError, match=r"checkpoint=best is not in .*: the run has not saved anything yet"):
            load_agent(tmp_path)

    @pytest.mark.parametrize("checkpoint", ["best", "last"])
    def test_a_run_whose_checkpoints_are_all_damaged(self, tmp_path, checkpoint):
        write_run(tmp_path)
        for manifest in tmp_path.rglob("manifest.json"):
            manifest.write_text("[]")
        with (
            pytest.warns(UserWarning, match="is damaged: manifest"),
            pytest.raises(SettingsError, match="can't be loaded"),
        ):
            load_agent(tmp_path, checkpoint=checkpoint)

    def test_checkpoints_that_are_no_folder(self, tmp_path):
        write_run(tmp_path, weights=False)
        (tmp_path / "checkpoints").write_text("")
        with pytest.raises(SettingsError, match="checkpoints must be what a run leaves there, got a file;"):
            load_agent(tmp_path)


class TestReadConfig:
    def test_what_was_written_comes_back(self, run, settings):
        config = read_config(run)
        assert config == resolved(settings) and plain(config) == plain(settings)
        assert "${" not in OmegaConf.to_yaml(config) and config.algo.sub.learning_rate_frames == config.total_frames

    def test_a_run_older_than_the_setting_was_in_single_precision(self, run):
        path = run / "config.yaml"
        path.write_text("".join(line for line in path.read_text().splitlines(True) if "precision" not in line))
        assert read_config(run).precision == "fp32"

    @pytest.mark.parametrize(
        "text",
        ["", "text", "[1, 2]", "3", "env: [", "\x00", "seed: 1", "env: &a [*a]", "{", "a: 1\na: 2\n: :", "- env: 1"],
        ids=repr,
    )
    def test_a_file_that_is_none(self, tmp_path, text):
        write_run(tmp_path, text, weights=False)
        with pytest.raises(SettingsError, match=r"config\.yaml can't be read as the settings of a run: .+"):
            read_config(tmp_path)

    def test_bytes_that_are_no_text(self, tmp_path):
        (tmp_path / "config.yaml").write_bytes(b"\xff\xfe\x00\x01")
        with pytest.raises(SettingsError, match=r"config\.yaml can't be read as the settings of a run: .+"):
            read_config(tmp_path)

    def test_a_folder_in_its_place(self, tmp_path):
        (tmp_path / "config.yaml").mkdir()
        with pytest.raises(SettingsError, match=r"run must be the folder of a training"):
            read_config(tmp_path)


@pytest.mark.parametrize(
    "content",
    [None, "", "[]", "3", "{}", '{"choices": 3}', '{"choices": [1]}', '{"choices": null}', "{" * 9, "\xff"],
    ids=repr,
)
def test_choices_that_can_not_be_read_are_none(tmp_path, content):
    if content is not None:
        (tmp_path / "run.json").write_text(content)
    assert read_choices(tmp_path) == {}


def test_choices_are_text_whatever_stands_there(tmp_path):
    (tmp_path / "run.json").write_text('{"choices": {"env": {"_target_": "os.system"}, "3": null}}')
    assert read_choices(tmp_path) == {"env": "{'_target_': 'os.system'}", "3": "None"}


def changed(**changes):
    """The text of a valid config.yaml with other values (``__`` for the dot in a key)."""
    config = configure()
    for key, value in changes.items():
        OmegaConf.update(config, key.replace("__", "."), value, merge=False, force_add=True)
    return OmegaConf.to_yaml(config)


def tagged(tag):
    """The text of a valid config.yaml with ``tag`` in place of the environment."""
    return changed(env="HERE").replace("env: HERE", f"env: {tag}")


MAKE = {"_target_": "os.makedirs", "name": "MARKER"}  # which Hydra itself would not refuse
HOSTILE = {
    "environment": lambda: changed(env=MAKE),
    "a part of a part": lambda: changed(algo__sub_exploration=MAKE),
    "in place of a number": lambda: changed(network__hidden_size=MAKE),
    "in a list": lambda: changed(logger__loggers=[MAKE]),
    "in a list of lists": lambda: changed(env__layout=[["#"], [{"rows": [MAKE]}]]),
    "through a module of the package": lambda: changed(
        network=MAKE | {"_target_": "hdrqn_torchrl.runs.checkpoint.os.makedirs"}
    ),
    "through a class of the package": lambda: changed(
        env={"_target_": "hdrqn_torchrl.learning.LearnerSettings.__init__.__globals__"}
    ),
    "torch.hub": lambda: changed(
        network={"_target_": "hdrqn_torchrl.runs.trainer.torch.hub.load", "repo_or_dir": "a/b"}
    ),
    "torch.load": lambda: changed(network={"_target_": "torch.load", "f": "MARKER", "weights_only": False}),
    "hydra itself": lambda: changed(env={"_target_": "hydra.utils.instantiate", "config": MAKE}),
    "partial": lambda: changed(env=MAKE | {"_partial_": True}),
    "arguments": lambda: changed(env={"_target_": "os.makedirs", "_args_": ["MARKER"]}),
    "exec": lambda: changed(env={"_target_": "builtins.exec", "_args_": ["open('MARKER', 'w')"]}),
    "name with a blank": lambda: changed(env=MAKE | {"_target_": "os.makedirs "}),
    "name from a variable": lambda: changed(env=MAKE | {"_target_": "${oc.env:HOSTILE_TARGET}"}),
    "name from another setting": lambda: changed(env=MAKE | {"_target_": "${output_root}"}, output_root="os.makedirs"),
    "name in two halves": lambda: changed(env=MAKE | {"_target_": "os.${output_root}"}, output_root="makedirs"),
    "name that changes with the device": lambda: changed(
        env__t={"auto": "hdrqn_torchrl.envs.MultiGoalGridEnv", "cpu": "os.makedirs"},
        env__device="auto",
        env__name="MARKER",
        env___target_="${.t.${.device}}",
    ),
    "name that changes with the number of worlds": lambda: changed(
        env__num_envs=4,
        network=MAKE
        | {"t": {"4": "hdrqn_torchrl.modules.compact_network", "1": "os.makedirs"}}
        | {"_target_": "${.t.${env.num_envs}}"},
    ),
    "settings for evaluations from a resolver": lambda: changed(
        evaluation__env="${oc.decode:'{layout: {_target_: os.makedirs, name: MARKER}}'}"
    ),
    "settings for evaluations": lambda: changed(evaluation__env={"layout": MAKE}),
    "a value of the reader's": lambda: changed(output_root="${oc.env:HOSTILE_TARGET}"),
    "a value of the reader's, quoted": lambda: changed(env__layout=["${oc.decode:${oc.env:HOSTILE_TARGET}}"]),
    "escaped": lambda: changed(output_root=r"\${oc.env:HOSTILE_TARGET}"),
    "a logger in an algorithm": lambda: changed(
        algo__sub_exploration={"_target_": "hdrqn_torchrl.runs.logging.make_tensorboard_logger", "folder": "MARKER"}
    ),
    "a logger in a logger": lambda: changed(
        logger__loggers=[
            {"_target_": "hdrqn_torchrl.runs.logging.make_wandb_logger", "project": MAKE | {"_recursive_": False}}
        ]
    ),
    "what a logger shows is built": lambda: changed(
        logger__loggers=[{"_target_": "hdrqn_torchrl.runs.logging.make_wandb_logger", "settings": MAKE}]
    ),
    "mode": lambda: changed(algo___convert_="all"),
    "section from another": lambda: changed(network__evil=MAKE, env="${network.evil}"),
    "section from a resolver": lambda: changed(env='${oc.create:{_target_: os.makedirs, name: "MARKER"}}'),
    "list from a resolver": lambda: changed(logger__loggers='${oc.create:[{_target_: os.makedirs, name: "MARKER"}]}'),
    "allowed by itself": lambda: changed(env=MAKE, allowed_targets=["os.makedirs"]),
    "allowed by itself, in part": lambda: changed(algo__sub=MAKE, allowed_targets=["os.makedirs"]),
    "shell": lambda: changed(network={"_target_": "os.system", "command": "touch MARKER"}),
    "tag": lambda: tagged("!!python/object/apply:os.makedirs [MARKER]"),
    "new tag": lambda: tagged("!!python/object/new:os.makedirs [MARKER]"),
    "name tag": lambda: tagged("{_target_: !!python/name:os.makedirs '', name: MARKER}"),
    "module tag": lambda: tagged("{_target_: !!python/module:os '', name: MARKER}"),
    "hydra's own section": lambda: changed(hydra={"callbacks": {"evil": MAKE}}),
    "unknown section": lambda: changed(evil=MAKE),
    "unknown resolver": lambda: changed(env__view="${eval:touch}"),
    "endless": lambda: changed(env__layout="${env}"),
    "no environment": lambda: changed(env=None),
    "an environment that is a number": lambda: changed(env=3),
    "no network": lambda: changed(network=None),
    "a list of algorithms": lambda: changed(algo=[{"_target_": "hdrqn_torchrl.algorithms.make_drqn"}]),
    "a builder in the wrong place": lambda: changed(env={"_target_": "hdrqn_torchrl.algorithms.make_drqn"}),
    "a builder with other arguments": lambda: changed(
        network={"_target_": "hdrqn_torchrl.modules.compact_network", "evil": 3}
    ),
    "a builder with a class for a number": lambda: changed(network__hidden_size="os.system"),
}


REFUSED_WHEN_BUILT = (
    "a builder with other arguments",
    "a builder with a class for a number",
)


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
    def test_what_is_checked_is_what_is_built(self, hostile_run):
        """Hydra follows references when it builds: this name is harmless before the device is set, and not after."""
        config = OmegaConf.create(HOSTILE["name that changes with the device"]())
        config.env.name = str(hostile_run(changed()) / "marker")
        assert plain(config.env)["_target_"] == "hdrqn_torchrl.envs.MultiGoalGridEnv"
        config.env.device = "cpu"
        assert plain(config.env)["_target_"] == "os.makedirs"
        with pytest.raises(SettingsError, match=r"env\._target_ must be one of .* got 'os\.makedirs'"):
            build_algorithm(config)
        config.env.device = "auto"
        with pytest.raises(InstantiationException, match="unexpected keyword argument 't'"):
            build_algorithm(config, {"device": "cpu"})

    def test_the_trap_works(self, tmp_path, monkeypatch):
        """Without the check it would be executed."""
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

    def test_allowed_by_the_caller_it_is_built(self, hostile_run):
        run = hostile_run(changed(network={"_target_": "hdrqn_torchrl.modules.Architecture"}))
        with pytest.raises(SettingsError, match=r"allowed_targets=\[hdrqn_torchrl\.modules\.Architecture\]"):
            load_agent(run)
        with pytest.raises(SettingsError, match=r"network: .*missing"):
            load_agent(run, allowed_targets=["hdrqn_torchrl.modules.Architecture"])


@dataclass
class Settings:
    """Of a script."""

    run: str = MISSING
    episodes: int = 10
    out: str | None = None
    files: Any = None


class TestCommandLine:
    @pytest.fixture
    def call(self, monkeypatch):
        def call(*arguments):
            seen = []
            monkeypatch.setattr("sys.argv", ["script.py", *arguments])
            command_line(Settings, "What it does.\n", seen.append)
            return seen[0]

        return call

    def test_arguments_fill_the_settings(self, call):
        assert call("run=outputs/x") == Settings("outputs/x", 10, None)
        assert call("run=a", "episodes=3", "out=b.gif") == Settings("a", 3, "b.gif")
        assert call("run=outputs/**", "out=*.png") == Settings("outputs/**", 10, "*.png")

    @pytest.mark.parametrize(
        "name",
        ["a #b", "a: b", "{a", "*a", "!a", "&a", "123", "1e3", "null", "true", "~", "-", "a b", "[a", "'a", '"a"',
         "a=b", "${oc.env:HOME}", "a, b", "%a", "@a", "`a", "|", ">", "", "2026-11-27"],
    )  # fmt: skip
    def test_a_name_is_taken_as_it_stands(self, call, name):
        settings = call(f"run={name}", f"out={name}", f"files={name}")
        assert settings == Settings(name, 10, name, None if name == "null" else name)

    def test_a_setting_that_takes_several_reads_a_list(self, call):
        assert call("run=a", "files=[a,'b #c']").files == ["a", "b #c"]

    @pytest.mark.parametrize("arguments", [["--help"], ["-h"], ["run=a", "--help"]], ids=str)
    def test_help(self, call, capsys, arguments):
        with pytest.raises(SystemExit) as stop:
            call(*arguments)
        assert stop.value.code == 0 and capsys.readouterr().out == "What it does.\n"

    def test_no_argument_at_all_shows_the_help_as_well(self, call, capsys):
        with pytest.raises(SystemExit) as stop:
            call()
        assert stop.value.code == 2 and capsys.readouterr().out == "What it does.\n"

    @pytest.mark.parametrize(
        ("arguments", "message"),
        [
            (["episodes=3"], "error: run must be given: run=...; --help shows all settings."),
            (["run"], "error: an argument must read key=value, got 'run'; --help shows all of them."),
            (["run=a", "-v"], "error: an argument must read key=value, got '-v'; --help shows all of them."),
            (
                ["run=a", "episods=3"],
                "error: Key 'episods' not in 'Settings'; the settings are run, episodes, out",
            ),
            (["run=a", "episodes=many"], "error: Value 'many' of type 'str' could not be converted to Integer; the "),
            (["run=a", "episodes=[1"], "error: "),
        ],
    )
    def test_a_wrong_one(self, call, arguments, message):
        with pytest.raises(SystemExit) as stop:
            call(*arguments)
        assert str(stop.value.code).startswith(message) and "\n" not in stop.value.code

    def test_settings_that_turn_out_to_be_wrong(self, monkeypatch):
        def work(_):
            raise SettingsError("run must be a folder.")

        monkeypatch.setattr("sys.argv", ["script.py", "run=a"])
        with pytest.raises(SystemExit) as stop:
            command_line(Settings, "doc", work)
        assert stop.value.code == "error: run must be a folder."
