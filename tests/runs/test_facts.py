"""A run goes on with the task that it was begun with."""

import warnings
from dataclasses import replace

import pytest
from helpers import small_env

from hdrqn_torchrl.runs.facts import check_facts, facts_of, warn_of_other_names, write_facts


def changed(env, **facts):
    env.task = replace(env.task, **facts)
    return env


@pytest.fixture
def run(tmp_path):
    write_facts(tmp_path, facts_of(small_env()))
    return tmp_path


def test_the_same_task_with_another_number_of_worlds_is_let_pass(run):
    check_facts(run, facts_of(small_env(7, seed=3)))


def test_a_run_of_an_earlier_version_is_let_pass(tmp_path):
    check_facts(tmp_path, facts_of(small_env()))


@pytest.mark.parametrize(
    ("env", "line"),
    [
        (lambda: small_env(max_steps=9), "longest episode: '7' -> 9"),
        (lambda: small_env(view=5), r"observation: .*\[3, 3\].* -> uint8 \[5, 5\].*"),
        (lambda: changed(small_env(), largest_return=99.0), r"largest return: \S+ -> 99\.0"),
        (lambda: changed(small_env(), actions=("a", "b", "c", "d")), "names of actions: .* -> a, b, c, d"),
        (
            lambda: changed(small_env(), subgoals=(replace(small_env().task.subgoals[0], names=("x", "y")),)),
            "names of subgoals: 'goal 1, goal 2' -> x, y",
        ),
        (lambda: changed(small_env(), ordered=False), "order of subgoals: 'True' -> False"),
    ],
)
def test_a_task_that_changed_is_refused_by_what_changed(run, env, line):
    with pytest.raises(ValueError, match=rf"^the task must be that of the run .*\n(  .*\n)*  {line}\n"):
        check_facts(run, facts_of(env()))


def test_other_names_are_warned_of_and_another_length_is_not(run):
    names = replace(small_env().task.subgoals[0], names=("goal 2", "goal 1"))
    with pytest.warns(UserWarning, match="names of subgoals: 'goal 1, goal 2' -> goal 2, goal 1. If their order"):
        warn_of_other_names(run, changed(small_env(), subgoals=(names,)))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warn_of_other_names(run, small_env(max_steps=9))
        (run / "task.json").write_text("{")  # an agent can play without
        warn_of_other_names(run, small_env())
