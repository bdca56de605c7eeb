"""An agent that finds its subgoals itself: what it has besides one whose subgoals are given."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

from torchrl.envs.transforms import Transform

from hdrqn_torchrl.algorithms.base import Algorithm, copies_of
from hdrqn_torchrl.algorithms.requirements import Requirements
from hdrqn_torchrl.discovery import DiscoveredSubgoals, Discovery, DiscoverySettings
from hdrqn_torchrl.learning import PhaseOne
from hdrqn_torchrl.modules import SuccessEpsilonGreedy


def finds_subgoals(
    subgoals: Literal["given", "discovered"],
    *,
    levels: int = 2,
    phase_one: PhaseOne | None = None,
    learns_all: bool = True,
) -> bool:
    """Whether an agent finds its subgoals itself.

    Args:
        subgoals: ``"given"`` or ``"discovered"``.
        levels: of the agent.
        phase_one: how long it chooses subgoals at random.
        learns_all: whether it learns about all subgoals from all steps.

    Raises:
        ValueError: if its other settings don't go with it.
    """
    if subgoals not in ("given", "discovered"):
        raise ValueError(f"subgoals must be 'given' or 'discovered', got {subgoals!r}; 'given' are those of the task.")
    if subgoals == "given":
        return False
    if levels != 2:
        raise ValueError(f"levels must be 2 with subgoals='discovered', got {levels}; it finds one set of subgoals.")
    if not learns_all:
        raise ValueError(
            "sub_hindsight must be True with subgoals='discovered', got False; a subgoal is learned from steps that "
            "were stored before it was found."
        )
    if phase_one is not None:
        raise ValueError(
            "phase_one must be None with subgoals='discovered': it waits for options of every subgoal, and there are "
            "none yet; leave it out."
        )
    return True


def finding_subgoals(algorithm: Algorithm, has: Requirements, settings: DiscoverySettings) -> Algorithm:
    """The agent with a critic of its own, which finds subgoals while it is trained.

    Args:
        algorithm: made for the set of subgoals that it will find.
        has: what the environment has.
        settings: how they are found.

    Raises:
        ValueError: if events can't be told in observations of this kind.
    """
    device = next(algorithm.policy.parameters()).device
    steps, *options = algorithm.learners.values()
    critic, selection = settings.make(has.observation, has.num_actions)
    critic.to(device)
    algorithm.policy.critic = critic  # only now: target networks have none
    before: tuple[Transform, ...] = (DiscoveredSubgoals(critic),)
    *nearer, farthest = algorithm.levels
    explorations = algorithm.explorations.values()
    successes = [each.success for each in explorations if isinstance(each, SuccessEpsilonGreedy)]
    return replace(
        algorithm,
        make_transforms=copies_of(*before, *algorithm.make_transforms().transforms),
        levels=(*nearer, replace(farthest, choice_names=critic.names)),
        monitors={
            **algorithm.monitors,
            "discovery": Discovery(critic, selection, steps, settings, options=options, successes=successes),
        },
    )
