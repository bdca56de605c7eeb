"""What a set of subgoals may be called, and which sets a task may have."""

import re

import pytest

from hdrqn_torchrl import keys
from hdrqn_torchrl.envs import SubgoalSet, Task
from hdrqn_torchrl.envs.subgoals import TAKEN_PREFIXES

GOALS = SubgoalSet(names=("x", "y"))


def rooms(prefix: str = "rooms") -> SubgoalSet:
    return SubgoalSet(names=("a", "b"), prefix=prefix)


def test_lists_of_names_and_sets_are_taken_as_tuples():
    task = Task(subgoals=[rooms(), SubgoalSet(names=["Küche", "living room"])], actions=["left", "right"])
    assert task.subgoals[1].names == ("Küche", "living room") and task.actions == ("left", "right")
    assert hash(task.subgoals[1]) is not None


@pytest.mark.parametrize(
    "settings, message",
    [
        ({"names": ()}, "names must be those of at least one subgoal, got none; leave the set out."),
        ({"names": "north"}, "names must be distinct, non-empty strings, got 'north'"),
        ({"names": ("a", "a")}, "names must be distinct, non-empty strings, got ('a', 'a')"),
        ({"names": (1, 2)}, "names must be distinct, non-empty strings, got (1, 2)"),
        ({"names": ("a", "")}, "names must be distinct, non-empty strings, got ('a', '')"),
        ({"prefix": None}, "prefix must be letters, digits and underscores, got None"),
        ({"prefix": "my rooms"}, "prefix must be letters, digits and underscores, got 'my rooms'"),
        ({"prefix": "a/b"}, "prefix must be letters, digits and underscores, got 'a/b'"),
        ({"prefix": "sub"}, "which name other things, got 'sub'; use another."),
        ({"prefix": "meta"}, "which name other things, got 'meta'; use another."),
        ({"repeatable": "no"}, "repeatable must be True or False, got 'no'."),
    ],
)
def test_a_set_that_can_not_be_named_is_refused(settings, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        SubgoalSet(**{"names": ("a", "b"), **settings})


def test_no_prefix_gives_an_entry_the_name_of_another_one():
    marked = keys.OptionKeys("PREFIX")
    properties = [name for name, value in vars(keys.OptionKeys).items() if isinstance(value, property)]
    own = {getattr(marked, name).removeprefix("PREFIX") for name in properties} | {"_hidden", "_cell"}
    others = {value for name, value in vars(keys).items() if name.isupper() and isinstance(value, str)}
    clashes = {other.removesuffix(name) for other in others for name in own if other.endswith(name)}
    assert {"active", "sub", "meta"} <= clashes <= set(TAKEN_PREFIXES)


@pytest.mark.parametrize(
    "sets, message",
    [
        (GOALS, "subgoals must be a tuple of SubgoalSet, got SubgoalSet("),
        (("x", "y"), "subgoals must be a tuple of SubgoalSet, got ('x', 'y')"),
        ((GOALS, rooms()), "subgoals must go from near to far: the farthest set, and it alone, has no prefix"),
        ((GOALS, GOALS), "subgoals must go from near to far: the farthest set, and it alone, has no prefix"),
        ((rooms(),), "got the prefixes ['rooms']; give each nearer set one."),
        ((rooms(), rooms(), GOALS), "none begins with another, got 'rooms' and 'rooms'"),
        ((rooms(), rooms("rooms_active"), GOALS), "none begins with another, got 'rooms' and 'rooms_active'"),
    ],
)
def test_sets_whose_entries_or_levels_could_be_mixed_up_are_refused(sets, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        Task(subgoals=sets)
