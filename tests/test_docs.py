"""What README.md and docs/ show works: Python blocks run, and commands have settings that exist."""

from __future__ import annotations

import math
import re
import shlex
import sys
from collections.abc import Iterator
from functools import cache
from importlib import import_module
from pathlib import Path

import pytest
import torch
from helpers import collect, tiny_settings
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import IntervalSweep
from run_folders import write_run

from hdrqn_torchrl.algorithms import make_v3
from hdrqn_torchrl.cli.check import composed
from hdrqn_torchrl.cli.command_line import command_line
from hdrqn_torchrl.cli.zoo import as_settings
from hdrqn_torchrl.envs import check_task
from hdrqn_torchrl.modules import compact_network
from hdrqn_torchrl.runs.settings.arguments import SettingsError
from hdrqn_torchrl.runs.settings.commands import PROGRAMS

ROOT = Path(__file__).parents[1]
README, PARTS = ROOT / "README.md", ROOT / "docs/parts.md"
PAGES = [README, *sorted((ROOT / "docs").glob("*.md")), *sorted((ROOT / "docs/tutorials").glob("*.md"))]
SHORTER = {
    "total_frames = 150_000": "total_frames = 2_048",  # before the first update is due
    "num_envs=250": "num_envs=4",
    "episodes=250": "episodes=4",
}
"""Replacements in Python blocks, so that they take seconds; test_learning.py runs that of docs/parts.md unchanged."""

RUN = "outputs/gridworld-v2/2026-11-22_16-04-11-seed0"
"""The run folder that the pages name."""
YOURS = "my_conf"
"""The folder that the pages name in place of a reader's own."""


def python_blocks(page: Path) -> list[str]:
    return re.findall(r"```python\n(.*?)```", page.read_text(), flags=re.S)


def commands(page: Path) -> list[str]:
    """Command lines in shell blocks, and those in running text."""
    text = page.read_text()
    blocks = "\n".join(re.findall(r"```bash\n(.*?)```", text, flags=re.S))
    lines = re.sub(r"\\\n\s*", "", blocks).splitlines()  # a backslash at the end goes on in the next line
    quoted = re.findall(r"(?<!`)`((?:python |hdrqn |make )[^`\n]+)`(?!`)", text)
    shown = [line.split("  #")[0].strip() for line in [*lines, *quoted] if line.strip() and "..." not in line]
    return [re.sub(r"(?<=\s)\[([^\]]*)\](?=\s|$)", r"\1", line) for line in shown]  # [what may be left out]


def calls(page: Path) -> Iterator[tuple[str, list[str]]]:
    """Calls of this project's programs, as (program, arguments)."""
    for line in commands(page):
        words = shlex.split(line, comments=True)
        if words[:2] == ["make", "train"]:
            yield "train", shlex.split("".join(words[2:]).removeprefix("ARGS="))
        elif words[0] == "hdrqn" and len(words) > 2:
            yield words[1], words[2:]
        elif words[0] == "python" and words[1].removesuffix(".py") in PROGRAMS:
            yield words[1].removesuffix(".py"), words[2:]


def jobs(arguments: list[str]) -> list[list[str]]:
    """Overrides of jobs that a call of train.py starts: each value of a swept setting occurs; of a range, its start."""
    overrides = [argument for argument in arguments if "=" in argument or argument.startswith("~")]
    values = []
    for override in OverridesParser.create().parse_overrides(overrides):
        if not override.is_sweep_override():
            values.append([override.input_line])
        elif isinstance(override.value(), IntervalSweep):
            values.append([f"{override.key_or_group}={override.value().start}"])
        else:
            values.append([f"{override.key_or_group}={value}" for value in override.sweep_string_iterator()])
    first = [each[0] for each in values]
    return [first, *([*first[:at], other, *first[at + 1 :]] for at, each in enumerate(values) for other in each[1:])]


@cache
def check_training(overrides: tuple[str, ...], folder: str | None = None) -> None:
    """Composes settings, with those of a user's folder, and checks their rules."""
    composed([*overrides, *([] if folder is None else ["--config-dir", str(ROOT / folder)])])


def without_seed(job: list[str]) -> tuple[str, ...]:
    return tuple(override for override in job if not override.startswith("seed="))


pages = pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)


@pages
def test_python_blocks_run_one_after_the_other(page, tmp_path, monkeypatch):
    run = tmp_path / RUN
    run.mkdir(parents=True)
    write_run(run)
    monkeypatch.chdir(tmp_path)
    names: dict = {"__name__": page.stem}
    for number, code in enumerate(python_blocks(page), start=1):
        if "(self, ...)" in code:  # a sketch: what it imports is there
            code = "\n".join(line for line in code.splitlines() if line.startswith(("from ", "import ")))
        for shown, run in SHORTER.items():
            code = code.replace(shown, run)
        torch.manual_seed(0)
        exec(compile(code, f"{page.name}, block {number}", "exec"), names)


def test_the_environment_of_the_page_on_tasks_keeps_the_contract_and_is_learned_from():
    names: dict = {}
    exec(next(code for code in python_blocks(ROOT / "docs/own_tasks.md") if "class Corridor" in code), names)
    env = names["Corridor"](4, seed=0)
    assert not [finding for finding in check_task(env) if finding.severity == "wrong"]
    agent = make_v3(env, compact_network(8, (8,)), learner=tiny_settings(sampling="episode_starts", slice_len=30))
    for batch in collect(agent, env, 40, batches=2):
        agent.observe(batch)
    assert all(math.isfinite(value) for value in agent.learners["joint"].learn().values())


@pages
def test_commands_have_settings_that_exist(page, monkeypatch):
    for program, arguments in calls(page):
        if program in ("train", "check"):
            folder = arguments[arguments.index("--config-dir") + 1] if "--config-dir" in arguments else None
            if folder != YOURS:
                for job in jobs(arguments):
                    check_training(without_seed(job), folder)
        else:
            seen: list = []
            arguments = as_settings(arguments) if program == "zoo" else arguments
            monkeypatch.setattr(sys, "argv", [f"{program}.py", *arguments])
            command_line(import_module(f"hdrqn_torchrl.cli.{program}").Settings, "", seen.append)
            assert seen or arguments == ["--help"]


@pages
def test_scripts_that_are_called_exist(page):
    for line in commands(page):
        words = shlex.split(line, comments=True)
        if words[0] == "python" and words[1].endswith(".py"):
            assert (ROOT / words[1]).is_file(), line


def test_a_setting_that_does_not_exist_is_noticed():
    with pytest.raises(SettingsError):
        check_training(("algo=v3", "algo.sub.tau=1"))
    with pytest.raises(SettingsError):
        check_training(("algo=v3", "+colour=red"))


def test_jobs_cover_every_value_of_a_sweep():
    swept = jobs(["algo=v1,v2", "seed=0,1", "algo.gamma=interval(0.9,1)"])
    assert [" ".join(job) for job in swept] == [
        "algo=v1 seed=0 algo.gamma=0.9",
        "algo=v2 seed=0 algo.gamma=0.9",
        "algo=v1 seed=1 algo.gamma=0.9",
    ]
