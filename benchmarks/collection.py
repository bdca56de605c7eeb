"""Hierarchical collection against a hand-written loop: ``python benchmarks/collection.py [--network paper]``.

Ours is TorchRL's ``Collector`` on the transformed environment with ``HierarchicalPolicy`` (hDRQNv2). The reference
below plays the same game on plain tensors: networks, epsilon-greedy choice, option book, grid rules, storage into
preallocated ``[N, T]`` tensors. Before timing, greedy play of both from the same seed is checked to be the same.
Prints one JSON object.
"""

from __future__ import annotations

import argparse
import json

import torch
from tensordict import TensorDictBase
from timing import compare
from torch import Tensor
from torchrl import torchrl_logger
from torchrl.collectors import Collector
from torchrl.envs import ExplorationType, TransformedEnv, set_exploration_type

from hdrqn_torchrl.algorithms import Algorithm, make_hdrqn
from hdrqn_torchrl.envs import MultiGoalGridEnv
from hdrqn_torchrl.envs.grid.rules import GridRules, GridState
from hdrqn_torchrl.modules import EpsilonGreedy, QNetwork, compact_network, paper_network

GAMMA, MAX_STEPS, NUM_GOALS = 0.99, 50, 2
ONE_HOT = torch.eye(NUM_GOALS)


class RawLoop:
    """N worlds with their options and LSTM states, stepped T times a call."""

    def __init__(
        self, rules: GridRules, meta: QNetwork, sub: QNetwork, *, num_envs: int, steps: int, seed: int
    ) -> None:
        self.rules, self.meta, self.sub, self.num_envs, self.steps = rules, meta, sub, num_envs, steps
        self.generator = torch.Generator().manual_seed(seed)
        self.world = rules.sample(num_envs, self.generator)
        self.observation = rules.observe(self.world)
        self.time = torch.zeros(num_envs, dtype=torch.int64)
        self.episode, self.episodes = torch.arange(num_envs), num_envs
        self.starts = self.is_init = torch.ones(num_envs, dtype=torch.bool)  # an option, an episode
        self.left = torch.ones(num_envs, rules.num_goals, dtype=torch.bool)
        self.subgoal, self.option_steps = torch.zeros(2, num_envs, dtype=torch.int64)
        self.option_return = torch.zeros(num_envs)
        self.sub_state = torch.zeros(2, num_envs, sub.hidden_size).unbind()
        self.meta_state = torch.zeros(2, num_envs, meta.hidden_size).unbind()
        self.storage: dict[str, Tensor] = {}

    @torch.no_grad()
    def collect(self, epsilon: float) -> dict[str, Tensor]:
        """Plays T steps in each world and returns what both learners need, ``[N, T, ...]``."""
        for step in range(self.steps):
            self.record(step, self.play(epsilon))
        return self.storage

    def record(self, step: int, entries: dict[str, Tensor]) -> None:
        """Writes one step of all worlds into the storage, which the first step allocates."""
        if not self.storage:
            self.storage = {
                name: value.new_empty((self.num_envs, self.steps, *value.shape[1:])) for name, value in entries.items()
            }
        for name, value in entries.items():
            self.storage[name][:, step] = value

    def play(self, epsilon: float) -> dict[str, Tensor]:
        """One step of all worlds."""
        starts, is_init, left, observation = self.starts, self.is_init, self.left, self.observation
        seen_hidden = self.sub_state[0]
        action = self.decide(epsilon)

        self.world, events = self.rules.step(self.world, action, self.generator)
        self.time = self.time + 1
        after = self.rules.observe(self.world)
        terminated = events.all_collected
        truncated = (self.time >= MAX_STEPS) & ~terminated
        done = terminated | truncated

        steps = self.option_steps.masked_fill(starts, 0)
        self.option_return = self.option_return.masked_fill(starts, 0.0) + GAMMA**steps * events.extrinsic_reward
        self.option_steps = steps + 1
        chosen = self.subgoal[:, None]
        reached = events.attained.gather(1, chosen).squeeze(1)
        option_done = reached | done | ~left.gather(1, chosen).squeeze(1)
        self.left = left & ~events.attained
        entries = {
            "observation": observation,
            "action": action,
            "subgoal": self.subgoal,
            "option_init": starts,
            "is_init": is_init,
            "episode": self.episode,
            "subgoal_mask": left,
            "sub_hidden": seen_hidden,
            "next_observation": after,
            "next_subgoal_mask": self.left,
            "next_sub_hidden": self.sub_state[0],
            "reward": events.reward,
            "extrinsic_reward": events.extrinsic_reward,
            "intrinsic_reward": reached.float() - events.hazard.float(),
            "success": events.success,
            "option_steps": self.option_steps,
            "option_return": self.option_return,
            "option_done": option_done,
            "option_terminated": reached | terminated,
            "done": done,
            "terminated": terminated,
            "truncated": truncated,
        }
        self.starts, self.is_init, self.observation = option_done, done, after
        if done.any():
            self.restart(done)
        return entries

    def decide(self, epsilon: float) -> Tensor:
        """Subgoal where an option starts, then the action; both LSTM states move on."""
        gate = self.starts[:, None]
        value, state = forward(self.meta, self.sub_state[0], self.meta_state)
        proposal = choose(
            value.masked_fill(~self.left & self.left.any(1, keepdim=True), -torch.inf), epsilon, self.left
        )
        self.subgoal = torch.where(self.starts, proposal, self.subgoal)
        self.meta_state = tuple(torch.where(gate, new, old) for new, old in zip(state, self.meta_state, strict=True))
        hidden, cell = (state.masked_fill(gate, 0.0) for state in self.sub_state)
        value, self.sub_state = forward(self.sub, self.observation, (hidden, cell), self.subgoal)
        return choose(value, epsilon)

    def restart(self, done: Tensor) -> None:
        """New worlds, books and LSTM states where an episode is over."""
        rows = done.nonzero().squeeze(1)
        fresh = self.rules.sample(len(rows), self.generator)
        self.world = GridState(*(old.index_copy(0, rows, new) for old, new in zip(self.world, fresh, strict=True)))
        self.observation = self.rules.observe(self.world)
        self.time = self.time.masked_fill(done, 0)
        self.left = self.left | done[:, None]
        self.episode = self.episode.index_copy(0, rows, self.episodes + torch.arange(len(rows)))
        self.episodes += len(rows)
        self.sub_state = tuple(state.masked_fill(done[:, None], 0.0) for state in self.sub_state)
        self.meta_state = tuple(state.masked_fill(done[:, None], 0.0) for state in self.meta_state)


def forward(
    network: QNetwork, inputs: Tensor, state: tuple[Tensor, ...], subgoal: Tensor | None = None
) -> tuple[Tensor, tuple[Tensor, ...]]:
    """Q-values and the state after one input, straight from the layers of a network."""
    features = network.features(inputs)
    if subgoal is not None:
        if network.gate is not None:
            features = features * network.gate(subgoal)
        features = torch.cat([features, ONE_HOT[subgoal]], 1)
    lstm = network.memory
    hidden, cell = torch.lstm_cell(
        features, state, lstm.weight_ih_l0, lstm.weight_hh_l0, lstm.bias_ih_l0, lstm.bias_hh_l0
    )
    streams = network.head.streams(hidden)
    advantage = streams[:, 1:]
    return streams[:, :1] + advantage - advantage.mean(1, keepdim=True), (hidden, cell)


def choose(value: Tensor, epsilon: float, allowed: Tensor | None = None) -> Tensor:
    """Epsilon-greedy over ``[N, A]``, random among ``allowed``."""
    greedy = value.argmax(1)
    if epsilon == 0.0:
        return greedy
    if allowed is None:
        random = torch.randint(value.shape[1], greedy.shape)
    else:
        random = torch.rand_like(value).masked_fill(~allowed, -1.0).argmax(1)
    return torch.where(torch.rand(len(greedy)) < epsilon, random, greedy)


def make(network: str, num_envs: int, epsilon: float) -> tuple[Algorithm, MultiGoalGridEnv, TransformedEnv]:
    """hDRQNv2 on the two-goal gridworld, exploring at a constant rate."""
    torch.manual_seed(0)
    env = MultiGoalGridEnv(num_envs=num_envs, num_goals=NUM_GOALS, max_steps=MAX_STEPS)
    algorithm = make_hdrqn(
        env,
        {"compact": compact_network, "paper": paper_network}[network](),
        gamma=GAMMA,
        sub_exploration=EpsilonGreedy(epsilon, epsilon),
        meta_exploration=EpsilonGreedy(epsilon, epsilon),
    )
    return algorithm, env, algorithm.transform(env)


def raw_loop(algorithm: Algorithm, env: MultiGoalGridEnv, *, steps: int, seed: int) -> RawLoop:
    """The reference with the same rules and weights."""
    policy = algorithm.policy
    networks = policy.meta_controller.network, policy.sub_controller.network
    return RawLoop(env.rules, *networks, num_envs=env.num_envs, steps=steps, seed=seed)


@torch.no_grad()
def check_equal(algorithm: Algorithm, env: MultiGoalGridEnv, transformed: TransformedEnv, steps: int = 60) -> None:
    """Checks that greedy play from the same seed gives the same steps, including resets."""
    transformed.set_seed(7)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        ours = transformed.rollout(steps, algorithm.policy, break_when_any_done=False)
    raw = raw_loop(algorithm, env, steps=steps, seed=7).collect(epsilon=0.0)
    after: TensorDictBase = ours["next"]
    same = {
        name: ours[name] for name in ("observation", "action", "option_init", "is_init", "subgoal_mask", "sub_hidden")
    }
    same |= {"subgoal": after["active_subgoal"], "next_observation": after["observation"]}
    same |= {f"next_{name}": after[name] for name in ("subgoal_mask", "sub_hidden")}
    same |= {name: after[name] for name in raw if name in after and name not in same}
    for name, value in same.items():
        torch.testing.assert_close(
            value.view_as(raw[name]), raw[name], atol=1e-5, rtol=1e-5, msg=lambda m, n=name: f"{n}: {m}"
        )
    assert bool(after["done"].any()), "the comparison must include ends of episodes"


def main() -> None:
    """Checks, times, prints."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--network", choices=["compact", "paper"], default="compact")
    parser.add_argument("--envs", type=int, default=64, help="N")
    parser.add_argument("--steps", type=int, default=8, help="T, steps of each environment in a batch")
    parser.add_argument("--epsilon", type=float, default=0.5)
    parser.add_argument("--blocks", type=int, default=20, help="pairs of blocks")
    parser.add_argument("--seconds", type=float, default=0.7, help="length of a block")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    torchrl_logger.setLevel("WARNING")  # it writes to standard output
    check_equal(*make(arguments.network, arguments.envs, arguments.epsilon))

    algorithm, env, transformed = make(arguments.network, arguments.envs, arguments.epsilon)
    frames = arguments.envs * arguments.steps
    collector = Collector(
        transformed,
        algorithm.policy,
        frames_per_batch=frames,
        total_frames=-1,
        device="cpu",
        auto_register_policy_transforms=False,
    )
    batches = iter(collector)
    raw = raw_loop(algorithm, env, steps=arguments.steps, seed=0)
    times = compare(
        lambda: next(batches),
        lambda: raw.collect(arguments.epsilon),
        blocks=arguments.blocks,
        seconds=arguments.seconds,
    )
    result = {"network": arguments.network, "envs": arguments.envs, "steps": arguments.steps, **times}
    for name in ("ours", "raw"):
        result[f"{name}_frames_per_second"] = round(1e3 * frames / times[f"{name}_ms"])
    print(json.dumps(result, indent=2))
    collector.shutdown()


if __name__ == "__main__":
    main()
