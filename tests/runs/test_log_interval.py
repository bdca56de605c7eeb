import pytest
import torch
from tensordict import TensorDict

from hdrqn_torchrl.runs.log_interval import LogInterval


def episodes(returns, attained=None):
    found = {"return": torch.tensor(returns)}
    if attained is not None:
        found["attained"] = torch.tensor(attained)
    return TensorDict(found, [len(returns)])


def test_a_log_point_averages_episodes_and_updates():
    window = LogInterval(frames=100)
    window.add_episodes([episodes([1.0, 2.0])])
    window.add_episodes([episodes([6.0])])
    for loss in (1.0, 3.0):
        window.add_update("meta", {"loss": torch.tensor(loss)})
    row = window.summary(200)
    assert (row["behaviour/return"], row["meta/loss"]) == (3.0, 2.0)


def test_without_episodes_there_are_no_columns_of_episodes():
    window = LogInterval()
    window.add_episodes([episodes([])])
    assert set(window.summary(10)) == {"frames_per_second"}


def test_a_restored_window_continues_where_the_other_was():
    window, other = LogInterval(frames=50), LogInterval()
    window.add_episodes([episodes([1.0])])
    window.add_update("sub", {"loss": torch.tensor(4.0)})
    other.load_state_dict(window.state_dict())
    other.add_update("sub", {"loss": torch.tensor(2.0)})
    row = other.summary(60)
    assert (row["behaviour/return"], row["sub/loss"]) == (1.0, pytest.approx(3.0))
