"""Checks whether an environment fulfils the contract for tasks, and says what each fault or gap costs.

    python check.py env=gridworld
    python check.py env=mine --config-dir my_conf allowed_targets=[my_package.MyEnv]
    python check.py env._target_=my_package.MyEnv allowed_targets=[my_package.MyEnv]

Takes the arguments of a training, of which it uses seed, env and network, and algo if it is given: whether that agent
can be made. Four worlds are stepped with random actions.
The exit code is 1 if something is wrong that prevents training, else 0. docs/own_tasks.md explains the contract.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from hydra import compose, initialize_config_dir
from hydra.errors import HydraException
from omegaconf import open_dict

from hdrqn_torchrl.cli.command_line import overrides_last, results_alone
from hdrqn_torchrl.cli.configuration import CONF, resolved
from hdrqn_torchrl.cli.misspelt import misspelt
from hdrqn_torchrl.runs.settings.arguments import SettingsError, remedy
from hdrqn_torchrl.runs.settings.building import build, build_env
from hdrqn_torchrl.runs.settings.commands import as_called, command_of
from hdrqn_torchrl.runs.settings.run_settings import RunSettings, check

WORLDS = 4


def main() -> None:
    """Runs with the arguments of the command line."""
    arguments = sys.argv[1:]
    if {"-h", "--help"} & set(arguments):
        print(as_called((__doc__ or "").strip()))
        return
    try:
        with results_alone():
            agent = any(each.lstrip("+~").startswith(("algo=", "algo.", "variant=")) for each in arguments)
            found = check_settings(composed(arguments), agent=agent)
    except ValueError as error:  # also of the environment's own parts, such as a critic
        sys.exit(f"error: {error}")
    print("\n".join(found))
    sys.exit(any(line.startswith("wrong") for line in found))


def composed(arguments: list[str]) -> RunSettings:
    """Settings as a training composes them, with ``--config-dir DIR`` among the arguments.

    Raises:
        SettingsError: if they can't be composed, or break a rule.
    """
    options = argparse.ArgumentParser(prog=command_of("check"), allow_abbrev=False)
    options.add_argument("--config-dir", "-cd", type=Path)
    options.add_argument("overrides", nargs="*")
    given = options.parse_args(overrides_last(arguments))
    overrides = list(given.overrides)
    if given.config_dir is not None:
        if not given.config_dir.is_dir():
            raise SettingsError(f"--config-dir must be a folder, got {str(given.config_dir)!r}, which is none.")
        overrides.append(f"hydra.searchpath=['file://{given.config_dir.absolute()}']")
    try:
        with initialize_config_dir(str(CONF), version_base="1.3"):
            config = compose("config", overrides=overrides, return_hydra_config=True)
    except HydraException as error:
        told = [each.removeprefix("error: ") for each in misspelt(arguments)]
        raise SettingsError(" ".join(told) or f"{str(error).splitlines()[0].rstrip('.')}; {remedy()}.") from error
    with open_dict(config):
        del config["hydra"]
    settings = resolved(config)
    check(settings)
    return settings


def check_settings(settings: RunSettings, *, agent: bool = False) -> list[str]:
    """What an agent sees and does in the environment that the settings describe, then its faults and gaps.

    Args:
        settings: of a training.
        agent: whether the agent that they describe is made, too.
    """
    from hdrqn_torchrl.envs import check_task  # takes seconds: it loads torch
    from hdrqn_torchrl.envs.findings import wrong
    from hdrqn_torchrl.runs.facts import facts_of

    changes = {"seed": settings.seed, "device": "cpu", "num_envs": WORLDS}
    env = build_env(settings, changes, settings.allowed_targets)
    network = build(settings.network, place="network", allowed=settings.allowed_targets)
    seen = [f"{name}: {value}" for name, value in facts_of(env).items() if value]
    findings = check_task(env, network_problem=network.observation_problem)
    if agent and not any(each.severity == "wrong" for each in findings):  # of which it would complain as well
        try:
            build(settings.algo, env, network, place="algo", allowed=settings.allowed_targets)
        except ValueError as error:
            findings.insert(0, wrong(str(error), "no agent can be made"))
    found = [str(finding) for finding in findings]
    return [*seen, *(found or ["nothing is wrong or missing"])]
