"""Worlds that stamp what they show, and parts of workers, for other processes to import."""

from __future__ import annotations

import os
import signal
import time
from dataclasses import replace

import torch
from tensordict import TensorDict
from torchrl.data import Bounded, Categorical, Composite
from torchrl.envs import EnvBase

from hdrqn_torchrl.algorithms import make_hdrqn, make_v3, presets
from hdrqn_torchrl.envs import MultiGoalGridEnv, SubgoalSet, Task
from hdrqn_torchrl.envs.specs import episode_ends, flags, rewards
from hdrqn_torchrl.modules import compact_network

EPISODE = 7


class StampedWorlds(EnvBase):
    """Shows which world this is (its seed and row), the number of its episode, and the step in it."""

    def __init__(self, num_envs, *, seed=0, device=None):
        super().__init__(device=device, batch_size=[num_envs])
        self.number, self.seed_of = num_envs, int(seed) % 1_000_000
        self.observation_spec = Composite(
            observation=Bounded(-1e6, 1e6, shape=(num_envs, 4), dtype=torch.float32),
            attained=flags(num_envs, 2),
            shape=(num_envs,),
        )
        self.action_spec = Categorical(2, shape=(num_envs,))
        self.full_reward_spec = rewards(num_envs, device=device)
        self.full_done_spec = episode_ends(num_envs, device=device)
        self.task = Task(subgoals=(SubgoalSet(names=("left", "right")),), max_steps=EPISODE)
        self.episode, self.time = torch.full((num_envs,), -1), torch.zeros(num_envs, dtype=torch.int64)
        self.generator = torch.Generator().manual_seed(self.seed_of)

    def _shown(self):
        rows = torch.arange(self.number)
        stamps = [torch.full_like(rows, self.seed_of), rows, self.episode, self.time]
        return torch.stack(stamps, -1).float()

    def _reset(self, tensordict=None):
        again = torch.ones(self.number, dtype=torch.bool)
        if tensordict is not None and "_reset" in tensordict:
            again = tensordict["_reset"].squeeze(-1)
        self.episode = self.episode + again.long()
        self.time = self.time.masked_fill(again, 0)
        no = torch.zeros(self.number, 1, dtype=torch.bool)
        entries = {"observation": self._shown(), "attained": no.expand(-1, 2).clone(), "done": no}
        return TensorDict({**entries, "terminated": no.clone(), "truncated": no.clone()}, [self.number])

    def _step(self, tensordict):
        self.time = self.time + 1
        over = (self.time >= EPISODE).unsqueeze(-1)
        attained = torch.rand(self.number, 2, generator=self.generator) < 0.15
        pay = attained[:, :1].float()
        entries = {"observation": self._shown(), "attained": attained, "reward": pay, "extrinsic_reward": pay}
        ends = {"done": over, "terminated": torch.zeros_like(over), "truncated": over.clone()}
        return TensorDict({**entries, **ends}, [self.number])

    def _set_seed(self, seed):
        pass

    def state_dict(self, *args, **kwargs):
        return {"episode": self.episode, "time": self.time, "generator": self.generator.get_state()}

    def load_state_dict(self, state, strict=True):
        self.episode, self.time = state["episode"], state["time"]
        self.generator.set_state(state["generator"])


LEARNER = {"warmup_frames": 0, "batch_size": 8, "capacity": 4_000}


def stamped_v3(env):
    settings = replace(presets.V3_LEARNER, slice_len=4, sampling="steps", stored_state=True, burn_in=0.25, **LEARNER)
    return make_v3(env, compact_network(8, (8,)), learner=settings, memory_size=8, head_size=8, prediction_steps=0)


def stamped_v2(env):
    return make_hdrqn(env, compact_network(8, (8,)))


AGENTS = {"v2": stamped_v2, "v3": stamped_v3}


def make_part(agent, worlds, index, seed):
    """A worker's part with stamped worlds."""
    env = StampedWorlds(worlds, seed=seed)
    algorithm = AGENTS[agent](env)
    return algorithm.transform(env), algorithm.policy


def make_grid_part(worlds, index, seed):
    """A worker's part in the gridworld."""
    env = MultiGoalGridEnv(num_envs=worlds, seed=seed)
    algorithm = AGENTS["v3"](env)
    return algorithm.transform(env), algorithm.policy


def make_failing_part(index, seed):
    """One that fails as a user's own code may."""
    raise RuntimeError("no such world")


def make_dying_part(index, seed):
    """One whose process ends at once."""
    os.kill(os.getpid(), signal.SIGKILL)


def make_slow_part(folder, index, seed):
    """One that hangs the first time."""
    mark = folder / f"{index}"
    if not mark.exists():
        mark.touch()
        time.sleep(1000)
    return make_part("v3", 2, index, seed)
