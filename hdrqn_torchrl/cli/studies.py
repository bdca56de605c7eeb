"""The paper's studies: which runs belong to each, how its figure is laid out, what the paper claims about it."""

from __future__ import annotations

import itertools
from collections.abc import Collection, Iterable
from dataclasses import dataclass
from functools import cache
from typing import Any

from hydra import compose, initialize_config_dir
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf

from hdrqn_torchrl.analysis.claims import Alike, Claim, Near, Ordered
from hdrqn_torchrl.analysis.comparison import GREEDY, PAPER, Panel
from hdrqn_torchrl.cli.configuration import CONF, plain
from hdrqn_torchrl.runs.settings.comparing import NOT_LEARNED_FROM, flat

_LEFT_TO_THE_TASK = ("max_target", "max_meta_target", "slice_len")  # null: as the task states its returns and episodes
ALGORITHMS = (  # the first three are the paper's
    Ordered("return", ["v2", "v1"]),
    Ordered("return", ["v1", "hdqn"]),
    Ordered("return", ["hdqn", ["drqn", "dqn"]]),
    Ordered("return", [["v1", "v2", "v3"], ["hdqn", "drqn", "dqn"]]),
    Ordered("return", ["v3", ["v1", "v2"]]),
)


@dataclass(frozen=True)
class Drawing:
    """One figure of a study."""

    shows: str
    ending: str
    """Of its file's name."""
    panels: tuple[Panel, ...]
    axis: str = "episodes"


AS_IN_PAPER = (Drawing("while training", "", PAPER), Drawing("greedy play", "_greedy", GREEDY))
SCREEN = (  # subgoals are numbered as in conf/env/montezuma.yaml
    Drawing(
        "while training (practice included) and, as points, greedy play from the start",
        "",
        (
            Panel("behaviour/return", "greedy/return", "score per episode"),
            Panel("behaviour/attained_3", label="episodes with the key"),
            Panel("behaviour/success", "greedy/success", "episodes that open a door"),
        ),
        axis="frames",
    ),
    *(
        Drawing(
            f"visits of the places on the {side} while training",
            f"_{side}",
            tuple(Panel(f"behaviour/visits_{number}", label=f"{name} per episode") for number, name in places),
            axis="frames",
        )
        for side, places in (
            ("right", ((0, "middle ladder"), (1, "bottom right ladder"), (5, "right door"))),
            ("left", ((2, "bottom left ladder"), (3, "key"), (4, "left door"))),
        )
    ),
)


@dataclass(frozen=True)
class Study:
    """One experiment of ``conf/experiment/``, and what is read off it."""

    name: str
    """File in ``conf/experiment/``."""
    title: str
    by: tuple[str, ...]
    """What makes a group: some of what the experiment sweeps over."""
    rows: str | None = None
    """What has a row of panels for each of its values."""
    beside: tuple[str, ...] = ()
    """Other algorithms' runs on the same task, shown for comparison: groups of the study ``gridworld``."""
    claims: tuple[Claim, ...] = ()
    sizes: tuple[str, ...] = ("small", "paper")
    """In which it exists."""
    drawings: tuple[Drawing, ...] = AS_IN_PAPER
    on_screen: bool = False
    """Its table is made from ``evaluations/*.json`` of the run folders, and there are pictures of legs."""


STUDIES = (
    Study(
        "sub_sequences",
        "Length of the sub level's sequences, n^S, at n^M = 1",
        by=("algo.sub.slice_len",),
        rows="algo",
        beside=("v3",),
        claims=tuple(
            claim
            for row in ("v1", "v2")
            for claim in (
                Alike("return", ["slice_len=8", "slice_len=12"], row=row),
                Ordered("return", [["slice_len=8", "slice_len=12"], ["slice_len=1", "slice_len=2"]], row=row),
            )
        ),
    ),
    Study(
        "meta_sequences",
        "Length of the meta level's sequences, n^M, at n^S = 8",
        by=("algo.meta.slice_len",),
        rows="algo",
        beside=("v3",),
        claims=(
            Ordered("return", ["slice_len=1", "slice_len=2"], row="v1"),
            Alike("return", ["slice_len=1", "slice_len=2"], row="v2"),
        ),
    ),
    Study(
        "views",
        "How much the agent sees",
        by=("env.view",),
        rows="algo",
        claims=tuple(Ordered("return", ["view=null", "view=5", "view=3"], row=row) for row in ("v1", "v2")),
    ),
    Study(
        "gridworld",
        "All algorithms, gridworld, two goals",
        by=("algo",),
        claims=(*ALGORITHMS, Near("steps", "v2", 22.0, within=1.5)),
    ),
    Study("gridworld_3_goals", "All algorithms, gridworld, three goals", by=("algo",), claims=ALGORITHMS),
    Study("four_rooms", "All algorithms, four rooms, two goals", by=("algo",), claims=ALGORITHMS),
    Study("four_rooms_3_goals", "All algorithms, four rooms, three goals", by=("algo",), claims=ALGORITHMS),
    Study(
        "authors_choices",
        "What the paper leaves open and the authors' program decides",
        by=("variant",),
        beside=("v3",),
    ),
    Study(
        "authors_choices_3_goals",
        "The same with three goals: choices that affect the meta level",
        by=("variant",),
    ),
    Study(
        "tuning_flat",
        "Search for the settings of DQN and DRQN",
        by=("algo.learner.learning_rate", "algo.learner.tau"),
        rows="algo",
        sizes=("small",),
        drawings=(),
    ),
    Study(
        "tuning_hierarchical",
        "Search for the settings of hDQN, v1 and v2",
        by=("algo.sub.learning_rate", "algo.sub.tau"),
        rows="algo",
        sizes=("small",),
        drawings=(),
    ),
    Study(
        "montezuma",
        "Montezuma's Revenge, first screen",
        by=("algo",),
        sizes=("small",),
        drawings=SCREEN,
        on_screen=True,
    ),
)


@dataclass(frozen=True)
class Job:
    """One run of a study."""

    overrides: dict[str, str]
    """What the sweep sets, as text."""
    settings: dict[str, Any]
    """By full name, without those that do not affect learning."""

    def label(self, keys: Iterable[str]) -> str:
        """Some of its overrides in short: the bare value where it names a file of conf/.

        Examples:
            >>> Job({"algo": "v2", "algo.sub.slice_len": "8"}, {}).label(["algo", "algo.sub.slice_len"])
            'v2, slice_len=8'
        """
        parts = (key.rpartition(".") for key in keys)
        return ", ".join(
            f"{last}={self.overrides[f'{path}.{last}']}" if path else self.overrides[last] for path, _, last in parts
        )


@cache
def jobs_of(experiment: str) -> tuple[Job, ...]:
    """Every run that ``python train.py -m experiment=...`` starts.

    Args:
        experiment: file in ``conf/experiment/`` with a sweep.
    """
    parser = OverridesParser.create()
    with initialize_config_dir(str(CONF), version_base="1.3"):
        first = f"experiment={experiment}"
        composed = compose("config", overrides=[first], return_hydra_config=True)
        files: list[Any] = []
        values: list[Any] = []  # composing takes long: once for each choice of files of conf/, not for each seed
        for key, swept in composed.hydra.sweeper.params.items():
            override = parser.parse_override(f"{key}={swept}")
            several = override.sweep_string_iterator() if override.is_sweep_override() else [swept]
            group = files if key in composed.hydra.runtime.choices else values
            group.append([(key, str(value)) for value in several])
        jobs = []
        for chosen in itertools.product(*files):
            config = compose("config", overrides=[first, *map("=".join, chosen)])
            for given in itertools.product(*values):
                for key, value in given:
                    OmegaConf.update(config, key, parser.parse_override(f"{key}={value}").value(), force_add=True)
                jobs.append(Job(dict([*chosen, *given]), flat(plain(config), without=NOT_LEARNED_FROM)))
    return tuple(jobs)


def is_run_of(job: Job, run: dict[str, Any], overridden: Collection[str] = ()) -> bool:
    """Whether a run was trained with a job's settings.

    Settings newer than the run are not compared, nor those that both leave to the task: older runs hold these as
    numbers, or as ``null`` for no bound.

    Args:
        job: of a study.
        run: the run's settings by full name.
        overridden: names of the settings that the run's command line gave values to: it left none of these to the task.
    """
    return all(
        job.settings.get(key) == value or (key not in overridden and _is_left_to_the_task(job, key, value))
        for key, value in run.items()
    )


def _is_left_to_the_task(job: Job, key: str, found: Any) -> bool:
    asked = job.settings.get(key, "")
    return key.rpartition(".")[2] in _LEFT_TO_THE_TASK and (asked is None or (asked == "unbounded" and found is None))
