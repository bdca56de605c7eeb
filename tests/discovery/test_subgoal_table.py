import pytest
import torch

from hdrqn_torchrl.discovery import SubgoalTable

EXPLORE, FIRST, SECOND = range(3)


@pytest.fixture
def table():
    table = SubgoalTable(2, max_tokens=4)
    table.assign({5: FIRST, 9: SECOND, 2: FIRST}, once=[FIRST])
    return table


def test_a_step_attains_the_subgoal_of_the_first_of_its_tokens_that_has_one(table):
    tokens = torch.tensor([[0, 0], [2, 0], [9, 5], [7, 5], [7, 10**12]])
    assert table.attained(tokens).long().tolist() == [[0, 0, 0], [0, 1, 0], [0, 0, 1], [0, 1, 0], [0, 0, 0]]
    assert not SubgoalTable(2).attained(tokens).any()


def test_only_subgoals_that_are_attained_once_are_spent_and_then_exploring_is_left(table):
    spent = torch.tensor([[0, 0, 0], [0, 1, 0], [0, 1, 1]]).bool()
    assert table.available(spent).long().tolist() == [[0, 1, 1], [0, 0, 1], [0, 0, 1]]
    table.assign({5: FIRST}, once=[FIRST])
    assert table.available(spent).long().tolist() == [[0, 1, 0], [1, 0, 0], [1, 0, 0]]
    assert SubgoalTable(2).available(spent).long().tolist() == [[1, 0, 0]] * 3


def test_assign_tells_which_slots_kept_an_event(table):
    assert table.assign({5: FIRST, 3: SECOND}).tolist() == [False, True, False]
    assert table.in_use.tolist() == [False, True, True] and not table.once.any()
    assert table.assign({}).tolist() == [False] * 3 and not table.in_use.any()


def test_a_table_travels_with_its_state(table):
    copy = SubgoalTable(2, max_tokens=4)
    copy.load_state_dict(table.state_dict())
    assert copy.tokens_of(FIRST) == [2, 5] and copy.once.tolist() == [False, True, False]


@pytest.mark.parametrize(
    ("slots", "once", "message"),
    [
        ({5: EXPLORE}, [], r"slots must lie in \[1, 3\), got 0; raise max_subgoals"),
        ({5: 3}, [], r"slots must lie in \[1, 3\), got 3"),
        ({5: 1}, [3], r"slots must lie in \[1, 3\), got 3"),
        (dict.fromkeys(range(5), 1), [], "slots must be of at most 4 tokens, got 5; leave some out"),
    ],
)
def test_events_without_a_slot_are_refused(table, slots, once, message):
    with pytest.raises(ValueError, match=message):
        table.assign(slots, once=once)
    assert table.tokens_of(FIRST) == [2, 5]
