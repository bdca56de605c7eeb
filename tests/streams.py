"""Numbered steps of episodes with known ends, and checks of the sequences drawn from them."""

import torch
from tensordict import TensorDict


class Stream:
    """Consecutive batches of numbered steps; episodes last 1 to 9 steps, and environments are not in step."""

    def __init__(self, num_envs):
        self.num_envs, self.next_episode = num_envs, 0
        self.generator = torch.Generator().manual_seed(num_envs)
        self.left, self.step, self.episode = [0] * num_envs, [0] * num_envs, [0] * num_envs

    def take(self, length):
        rows = [[self._advance(n) for _ in range(length)] for n in range(self.num_envs)]
        episode, step, last = torch.tensor(rows).unbind(-1)
        done = last.bool().unsqueeze(-1)
        td = TensorDict(step=step, is_init=(step == 0).unsqueeze(-1), batch_size=[self.num_envs, length])
        td["collector", "traj_ids"] = episode
        td["next"] = TensorDict(
            done=done, terminated=done, truncated=torch.zeros_like(done), batch_size=[self.num_envs, length]
        )
        return td

    def _advance(self, n):
        if self.left[n] == 0:
            self.left[n] = int(torch.randint(1, 10, (), generator=self.generator))
            self.step[n], self.episode[n] = -1, self.next_episode
            self.next_episode += 1
        self.left[n] -= 1
        self.step[n] += 1
        return self.episode[n], self.step[n], int(self.left[n] == 0)


def check_sequences(sequences, slice_len, newest):
    """Checks that each sequence is one trajectory of consecutive steps, at least one real, padded only at its end."""
    traj, step = sequences["collector", "traj_ids"], sequences["step"]
    real = sequences.get(("collector", "mask"), torch.ones_like(step, dtype=torch.bool))
    assert sequences.shape[1] == slice_len
    assert real[:, 0].all() and (real[:, 1:] <= real[:, :-1]).all()
    assert (traj == traj[:, :1]).all()
    assert (step == step[:, :1] + torch.arange(slice_len))[real].all()
    last = real.sum(-1, keepdim=True) - 1
    assert (step == step.gather(1, last))[~real].all()  # padding repeats the last real step
    ended = sequences["next", "terminated"].squeeze(-1).gather(1, last).squeeze(-1)
    pairs = torch.stack([traj, step], -1)[torch.arange(len(last)), last.squeeze(-1)].tolist()
    waits = torch.tensor([tuple(pair) in newest for pair in pairs])  # its episode goes on in the next batch
    assert (ended | waits)[~real[:, -1]].all()
    assert ((step == 0) == sequences["is_init"].squeeze(-1)).all()  # the flag of true starts is kept


def one_episode(number, length):
    td = TensorDict(step=torch.arange(length), batch_size=[length])
    td["collector", "traj_ids"] = torch.full((length,), number)
    td["is_init"], done = (td["step"] == 0).unsqueeze(-1), (td["step"] == length - 1).unsqueeze(-1)
    td["next"] = TensorDict(done=done, terminated=done, truncated=torch.zeros_like(done), batch_size=[length])
    return td
