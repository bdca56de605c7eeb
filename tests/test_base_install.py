"""The package with its dependencies alone, as ``pip install -e .`` leaves it: what belongs to an extra is not there."""

from importlib.metadata import PackageNotFoundError, packages_distributions, requires

import pytest
from packaging.requirements import Requirement
from programs import TINY, call

HIDE = """
import sys
from importlib.machinery import PathFinder

class WithoutExtras(PathFinder):
    @classmethod
    def find_spec(cls, name, path=None, target=None):
        return None if name.partition(".")[0] in {hidden} else super().find_spec(name, path, target)

sys.meta_path[sys.meta_path.index(PathFinder)] = WithoutExtras
sys.argv = ["hdrqn", *{arguments}]
from hdrqn_torchrl.cli.__main__ import main
main()
"""


def needed(project, found):
    """Names of the distributions that a project needs without any of its extras."""
    try:
        wanted = map(Requirement, requires(project) or [])
    except PackageNotFoundError:
        return found
    for each in wanted:
        name = each.name.lower().replace("_", "-")
        if name not in found and (each.marker is None or each.marker.evaluate({"extra": ""})):
            found.add(name)
            needed(name, found)
    return found


@pytest.fixture(scope="module")
def hidden():
    """Packages of this environment that a plain installation would not have."""
    there = needed("hdrqn_torchrl", {"hdrqn-torchrl", "setuptools", "pip"})
    modules = {
        module
        for module, projects in packages_distributions().items()
        if not {project.lower().replace("_", "-") for project in projects} & there
    }
    assert {"hydra_plugins", "onnx", "pytest"} <= modules and not modules & {"torch", "hydra", "matplotlib", "yaml"}
    return sorted(modules)


def test_agents_are_trained_evaluated_watched_and_plotted(hidden, tmp_path):
    for arguments in (
        ["train", *TINY, "algo=v3", "logger=tensorboard", "hydra.run.dir=run"],
        ["train", "-m", *TINY, "algo=drqn", "seed=0,1", "total_frames=500", "hydra.sweep.dir=sweep"],
        ["evaluate", "run=run", "episodes=8"],
        ["watch", "run=run", "out=episode.gif", "episodes=1"],
        ["plot", "runs=[run,sweep]", "out=curves.png"],
        ["export", "run=run", "out=agent.pt2", "episodes=1"],
        ["check", "env=gridworld"],
    ):
        done = call(tmp_path, "-c", HIDE.format(hidden=hidden, arguments=arguments))
        assert done.returncode == 0, (arguments, done.stderr)


@pytest.mark.parametrize(
    ("arguments", "extra"),
    [
        (["train", "env=montezuma"], "atari"),
        (["train", "env=minigrid"], "minigrid"),
        (["train", "-m", "seed=0,1", "sweep=parallel"], "sweep"),
        (["train", "-m", "seed=0,1", "sweep=search"], "search"),
        (["train", "-m", "seed=0,1", "sweep=slurm"], "slurm"),
        (["train", "-m", "seed=0,1", "sweep=ray"], "ray"),
        (["train", "collector=ray"], "ray"),
        (["train", "logger=wandb"], "wandb"),
    ],
    ids=str,
)
def test_what_an_extra_is_for_is_asked_for_by_name(hidden, tmp_path, arguments, extra):
    done = call(tmp_path, "-c", HIDE.format(hidden=hidden, arguments=[*arguments, *TINY[2:], "device=cpu"]))
    assert done.returncode != 0
    assert f"pip install 'hdrqn_torchrl[{extra}]'" in done.stderr, done.stderr[-800:]
    assert "Traceback" not in done.stderr
