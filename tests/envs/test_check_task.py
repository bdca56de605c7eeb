"""Environments with one fault each are reported with it; the project's own have none."""

import re
from dataclasses import replace

import pytest
import torch
from helpers import small_env
from torchrl.data import Binary, MultiCategorical, Unbounded
from torchrl.envs import SerialEnv, StepCounter, TransformedEnv
from user_envs import Corridor

from hdrqn_torchrl.envs import MultiGoalGridEnv, SubgoalSet, Task, check_task

WHOLE = Task(
    max_steps=6,
    largest_return=6.0,
    largest_extrinsic_return=6.0,
    smallest_extrinsic_return=0.0,
    subgoals=(SubgoalSet(names=("left", "right"), repeatable=True),),
    actions=("left", "right"),
)


def corridor(cls=Corridor, *, task=WHOLE, **settings):
    return cls(4, task=task, without=(), **settings)


def wrong(env):
    return [finding.what for finding in check_task(env, steps=60) if finding.severity == "wrong"]


def missing(env):
    return {finding.costs for finding in check_task(env, steps=60) if finding.severity == "missing"}


class Standing(Corridor):
    """Attains an end in every step that it stays there."""

    def _written(self, moved, *specs):
        return super()._written(torch.ones_like(moved), *specs)


class Endless(Corridor):
    """Its episodes are longer than it states."""

    def _step(self, tensordict):
        after = super()._step(tensordict)
        return after.update({key: torch.zeros_like(after[key]) for key in ("done", "truncated")})


class Careless(Corridor):
    """``done`` without a reason."""

    def _step(self, tensordict):
        after = super()._step(tensordict)
        return after.set("truncated", torch.zeros_like(after["done"]))


class Shapeless(Corridor):
    def _step(self, tensordict):
        after = super()._step(tensordict)
        return after.set("reward", after["reward"].double())


class Forgetful(Corridor):
    """Does not store where it is."""

    def state_dict(self, *args, **kwargs):
        return {"steps": self._steps}

    def load_state_dict(self, state_dict, strict=True):
        self._steps = state_dict["steps"]


class PaidLate(Corridor):
    """Pays for nothing but the end of an episode, which it calls truncated."""

    def _step(self, tensordict):
        after = super()._step(tensordict)
        return after.update({key: after["truncated"].float() for key in ("reward", "extrinsic_reward")})


class Stateless(Corridor):
    def state_dict(self, *args, **kwargs):
        return {}


class Random(Corridor):
    """Starts anywhere, whatever the seed."""

    def _reset(self, tensordict, **kwargs):
        super()._reset(tensordict, **kwargs)
        self._place = torch.randint(1, 4, self.batch_size, generator=self.generator())
        return self._written(
            torch.zeros_like(self._place, dtype=torch.bool), self.observation_spec, self.full_done_spec
        )

    def generator(self):
        if not hasattr(self, "_generator"):
            self._generator = torch.Generator().manual_seed(0)
        return self._generator


class Deaf(Random):
    """Begins with the same seed every time."""

    def _set_seed(self, seed):
        self.generator().manual_seed(0)


@pytest.mark.parametrize(
    "env",
    [
        MultiGoalGridEnv(4, seed=0),
        MultiGoalGridEnv(4, layout="four_rooms", num_goals=3, obstacle="teleport", places=True),
        MultiGoalGridEnv(4, layout="nine_rooms", max_steps=150),
        small_env(4, max_steps=9),
    ],
    ids=["open", "four_rooms", "nine_rooms", "small"],
)
def test_the_grids_have_no_faults_and_no_gaps(env):
    assert check_task(env, steps=120) == []


def test_a_complete_task_without_players_and_scene_has_two_gaps():
    assert wrong(corridor()) == []
    assert missing(corridor()) == {"no ceiling line", "watch.py shows observations as numbers"}


class Locked(Corridor):
    """Nothing can be done at the ends."""

    def _doors(self):
        return super()._doors() & super()._doors().all(-1, keepdim=True)


class Late(Corridor):
    """Says what can be done only after the first step."""

    def _reset(self, tensordict, **kwargs):
        return super()._reset(tensordict, **kwargs).exclude("action_mask")


@pytest.mark.parametrize(
    "env, fault",
    [
        (corridor(Locked, masked=True), "'action_mask' must allow at least one action, at a reset and until"),
        (
            corridor(masked=True, odd={"action_mask": Binary(shape=(4, 3))}),
            r"'action_mask' must be torch.bool \[4, 2\]",
        ),
        (corridor(PaidLate), "most of the reward is paid in steps that are 'truncated'"),
        (corridor(Standing, task=Task()), "'attained' must be true once in an episode"),
        (corridor(Standing), "'attained' must be true only in the step that attains a subgoal"),
        (corridor(task=Task(subgoals=(SubgoalSet(names=("a", "b")),))), "'attained' must be true once in an episode"),
        (corridor(task=Task(subgoals=(SubgoalSet(names=("a",)),))), r"'attained' must be torch.bool \[4, 1\]"),
        (
            corridor(task=Task(subgoals=(SubgoalSet(names=("a",), prefix="near"), *WHOLE.subgoals))),
            "'near_attained' is missing",
        ),
        (corridor(task=replace(WHOLE, actions=("left",))), "the task must name 2 actions, or none, and names 1"),
        (corridor(task={"max_steps": 6}), "'task' must be a Task, got {'max_steps': 6}"),
        (corridor(odd={"attained": Unbounded((4, 2))}), r"'attained' must be torch.bool \[4, 2\], got torch.float32"),
        (corridor(odd={"hazard": Binary(shape=(4,), dtype=torch.bool)}), r"'hazard' must be torch.bool \[4, 1\]"),
        (corridor(Endless), "an episode went on after max_steps=6"),
        (corridor(Careless), "'done' must be 'terminated' or 'truncated'"),
        (corridor(Shapeless), "'reward' must be torch.float32 .* as its spec says, got torch.float64"),
        (corridor(pays=10.0), r"the sum of 'reward' must lie in \[-inf, 6\]"),
        (corridor(pays=float("nan")), "'reward' must be finite"),
        (corridor(pays=-1.0), r"the sum of 'extrinsic_reward' must lie in \[0, 6\]"),
        (corridor(Random), "the same seed must give the same worlds"),
        (corridor(Deaf), "another seed must give other worlds"),
        (corridor(Forgetful), r"state_dict\(\) must hold the whole state"),
        (Corridor(None, task=WHOLE), r"the batch size must be \[N\]"),
        (corridor(odd={"action": Unbounded((4, 1))}), "'action' must be one number"),
    ],
    ids=lambda each: each if isinstance(each, str) else "",
)
def test_a_fault_is_found_and_named(env, fault):
    found = wrong(env)
    assert any(re.match(fault, each) for each in found), found


class Unseeing(Corridor):
    """Shows no number."""

    shown = float("nan")

    def _written(self, moved, *specs):
        after = super()._written(moved, *specs)
        return after.set("observation", torch.full_like(after["observation"], self.shown))


class Overflowing(Unseeing):
    """Shows a code that there is not."""

    shown = 7


@pytest.mark.parametrize(
    ("env", "fault"),
    [
        (
            corridor(Unseeing, odd={"observation": Unbounded((4, 3))}),
            "'observation' must be finite numbers, and is not",
        ),
        (corridor(Overflowing), "'observation' must be codes below 5 at entry 0 as its spec says, got 7"),
    ],
)
def test_values_that_are_no_numbers_or_no_codes_are_the_only_fault_that_is_told(env, fault):
    assert wrong(env) == [fault]


class Changing(Corridor):
    """After some steps its observation has another shape."""

    def _step(self, tensordict):
        self.calls = getattr(self, "calls", 0) + 1
        after = super()._step(tensordict)
        return after if self.calls < 9 else after.set("observation", after["observation"][..., :1].double())


class Raising(Changing):
    def _step(self, tensordict):
        after = super()._step(tensordict)
        if self.calls > 9:
            raise ZeroDivisionError("no way")
        return after


def test_what_goes_wrong_only_after_some_steps_is_a_fault_too():
    (fault,) = wrong(Changing(4))
    assert fault.startswith("'observation' must be ") and "as its spec says, got torch.float64" in fault
    (fault,) = wrong(Raising(4))
    assert fault.startswith(f"stepping it raised ZeroDivisionError: no way ({__file__}:")


@pytest.mark.parametrize(
    "env, costs",
    [
        (corridor(Stateless), "no resume: a training that was stopped starts from scratch"),
        (Corridor(4, task=WHOLE), "no success rate"),
        (Corridor(4, task=WHOLE), "no penalty for hazards"),
        (Corridor(4, without=("attained", "hazard", "success")), "agents of one level only"),
        (Corridor(4, task=WHOLE, without=("extrinsic_reward",)), "agents of one level only"),
        (Corridor(4), "targets are not bounded, and a resume does not notice other rewards"),
        (Corridor(4), "evaluations need max_steps, v3 needs slice_len"),
        (Corridor(4), "they have no names, and there is no third level"),
        (Corridor(4), "watch.py numbers them"),
        (Corridor(4, odd={"observation": Unbounded((4, 3), dtype=torch.float64)}), "built-in networks can't read it"),
        (Corridor(4, odd={"observation": MultiCategorical([5, 3], (4, 2))}), "replay memories are 8 times as large"),
    ],
)
def test_a_gap_is_named_with_what_it_costs(env, costs):
    assert costs in missing(env)


def test_only_actions_that_can_be_chosen_are_tried():
    assert wrong(corridor(masked=True)) == []


def test_environments_are_checked_through_transforms_and_batches():
    assert wrong(TransformedEnv(corridor(), StepCounter(max_steps=4))) == []
    assert not [each for each in wrong(SerialEnv(3, lambda: Corridor(None, without=(), task=WHOLE))) if "seed" in each]


def test_checking_does_not_affect_random_numbers():
    env = MultiGoalGridEnv(2, seed=0)
    before = torch.get_rng_state()
    check_task(env, steps=5)
    assert torch.equal(torch.get_rng_state(), before)


def test_a_finding_is_printed_with_its_severity_and_cost():
    finding = next(each for each in check_task(corridor(), steps=5) if "players" in each.what)
    assert str(finding) == "missing: there are no scripted players (no ceiling line)"
    with pytest.raises(ValueError, match="steps must be >= 1, got 0"):
        check_task(corridor(), steps=0)
