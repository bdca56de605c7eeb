import pytest
import torch
from streams import Stream, one_episode
from tensordict import TensorDict

from hdrqn_torchrl.data import LongerEpisodes


@pytest.mark.parametrize("length", [1, 3, 8, 9])
@pytest.mark.parametrize("batch_len", [1, 4, 30])
def test_longer_episodes_are_found_over_many_batches_as_by_a_plain_loop(length, batch_len):
    """Episodes of the stream last up to nine steps; its steps are numbered."""
    stream, longer = Stream(3), LongerEpisodes(length)
    for _ in range(60 // batch_len):
        batch = stream.take(batch_len)
        assert longer.seen(batch) == (batch["step"] >= length).any().item()


def test_each_piece_of_rows_is_measured_separately():
    longer = LongerEpisodes(4)
    assert not longer.seen(torch.cat([one_episode(0, 4), one_episode(1, 2)]))
    assert not longer.seen(one_episode(2, 3)) and longer.seen(one_episode(3, 5))


def test_an_episode_whose_beginning_is_unknown_counts_from_the_first_step_that_is_seen():
    steps, longer = TensorDict(is_init=torch.zeros(2, 3, 1, dtype=torch.bool), batch_size=[2, 3]), LongerEpisodes(3)
    assert [longer.seen(steps) for _ in range(2)] == [False, True]
