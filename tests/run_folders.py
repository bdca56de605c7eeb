"""Run folders with small settings, and with hostile ones."""

import json
from functools import cache

import torch
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from hdrqn_torchrl.cli import configuration
from hdrqn_torchrl.cli.configuration import resolved
from hdrqn_torchrl.runs.persistence.checkpoint import Checkpoints
from hdrqn_torchrl.runs.persistence.weights import save_weights
from hdrqn_torchrl.runs.settings.building import build_algorithm

CONF = str(configuration.CONF)
SMALL = ("network.hidden_size=8", "network.widths=[8]", "env.view=3", "env.num_envs=4", "algo.sub.batch_size=4")


@cache
def composed():
    with initialize_config_dir(CONF, version_base="1.3"):
        return compose("config", overrides=list(SMALL))


def configure():
    """A valid configuration, whose values may be replaced by any others."""
    return OmegaConf.create(OmegaConf.to_container(composed()))


def write_run(folder, text=None, *, weights=True):
    config = configure()
    (folder / "config.yaml").write_text(OmegaConf.to_yaml(config) if text is None else text)
    (folder / "run.json").write_text(json.dumps({"choices": {"env": "gridworld", "algo": "v2"}}))
    if not weights:
        return
    torch.manual_seed(0)
    _, algorithm = build_algorithm(resolved(config))
    checkpoints = Checkpoints(folder / "checkpoints")
    for step, score in ((100, 0.5), (200, None)):
        with torch.no_grad():
            algorithm.policy.sub_controller.network.head.streams.bias.fill_(step)
        checkpoints.save({"policy": algorithm.policy, "rest": torch.nn.Linear(1, 1)}, step=step, score=score)
    save_weights(algorithm.policy, folder / "weights.safetensors")


def changed(**changes):
    """The text of a valid config.yaml with other values (``__`` for the dot in a key)."""
    config = configure()
    for key, value in changes.items():
        OmegaConf.update(config, key.replace("__", "."), value, merge=False, force_add=True)
    return OmegaConf.to_yaml(config)


def tagged(tag):
    """The text of a valid config.yaml with ``tag`` instead of the environment."""
    return changed(env="HERE").replace("env: HERE", f"env: {tag}")


MAKE = {"_target_": "os.makedirs", "name": "MARKER"}  # which Hydra itself would not refuse
HOSTILE = {
    "environment": lambda: changed(env=MAKE),
    "a part of a part": lambda: changed(algo__sub_exploration=MAKE),
    "in place of a number": lambda: changed(network__hidden_size=MAKE),
    "in a list": lambda: changed(logger__loggers=[MAKE]),
    "in a list of lists": lambda: changed(env__layout=[["#"], [{"rows": [MAKE]}]]),
    "through a module of the package": lambda: changed(
        network=MAKE | {"_target_": "hdrqn_torchrl.runs.persistence.durable.os.makedirs"}
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
