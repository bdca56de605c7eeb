"""When updates are due, by hand."""

import pytest

from hdrqn_torchrl.learning.update_schedule import UpdateSchedule


def schedule(frames, updates=0, *, warmup_frames=10, frames_per_update=4.0):
    made = UpdateSchedule(warmup_frames, frames_per_update)
    made.frames, made.updates = frames, updates
    return made


@pytest.mark.parametrize(
    ("frames", "updates", "due", "owed"),
    [(0, 0, 0, -10), (10, 0, 0, 0), (17, 0, 1, 7), (18, 0, 2, 8), (18, 2, 0, 0), (18, 5, 0, -12), (110, 5, 20, 80)],
)
def test_updates_are_due_for_the_frames_after_the_warm_up(frames, updates, due, owed):
    found = schedule(frames, updates)
    assert (found.due, found.frames_owed) == (due, owed)


def test_updates_that_are_let_go_are_never_made_and_later_ones_are():
    found = schedule(21, 1)
    found.let_go()
    assert (found.due, found.frames_owed) == (0, 0)
    found.frames += 8
    assert found.due == 2
    ahead = schedule(18, 5)
    ahead.let_go()
    assert ahead.frames_owed == -12  # nothing is owed: nothing changes


@pytest.mark.parametrize("updates", [0, 3, 100])
def test_a_second_warm_up_takes_as_long_as_the_first(updates):
    found = schedule(50, updates)
    found.warm_up_again()
    due = []
    for _ in range(14):
        found.frames += 1
        due.append(found.due)
    if updates * 4 <= 60:
        assert due == [0] * 13 + [1]
    else:
        assert not any(due)  # more were made than the frames ask for


def test_counts_survive():
    first, second = schedule(50, 3), schedule(0)
    first.let_go()
    second.check(first.state_dict(), most_owed=0)
    second.load_state_dict(first.state_dict())
    assert (second.frames, second.updates, second.warm_at) == (50, 3, first.warm_at)
    with pytest.raises(ValueError, match="updates must make up for its frames, got 3 for 1000"):
        second.check(first.state_dict() | {"frames": 1000}, most_owed=900)
