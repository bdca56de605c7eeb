"""The sequence loss and the replay memory, with only TorchRL's own modules around them.

Task: CartPole without velocities. An observation shows where cart and pole are; to know their speed takes a memory.
Network: ``MLP -> LSTMModule -> MLP -> QValueModule``. From this project come ``RecurrentDQNLoss``, which unrolls any
such network over replayed sequences, and ``make_sequence_buffer``, which draws them.

Run ``python examples/reuse_loss.py [--updates 2500]``.
"""

from __future__ import annotations

import argparse

import gymnasium
import torch
from gymnasium.spaces import Box
from gymnasium.wrappers import TransformObservation
from tensordict.nn import TensorDictModule, TensorDictSequential
from torchrl import torchrl_logger
from torchrl.collectors import Collector
from torchrl.envs import (
    Compose,
    ExplorationType,
    GymWrapper,
    InitTracker,
    RewardSum,
    SerialEnv,
    TransformedEnv,
    set_exploration_type,
)
from torchrl.modules import MLP, EGreedyModule, LSTMModule, QValueModule
from torchrl.objectives import SoftUpdate

from hdrqn_torchrl.data import make_sequence_buffer, sample_sequences
from hdrqn_torchrl.objectives import RecurrentDQNLoss

NUM_ENVS, STEPS, SLICE_LEN, BATCH_SIZE, HIDDEN = 16, 8, 16, 32, 64


def cartpole_without_velocities() -> GymWrapper:
    """Position of the cart and angle of the pole, both scaled to about 1."""
    env = gymnasium.make("CartPole-v1")
    positions = TransformObservation(env, lambda full: full[[0, 2]] * [0.5, 5.0], Box(-3, 3, (2,)))
    return GymWrapper(positions, categorical_action_encoding=True)


def make_network() -> tuple[TensorDictSequential, LSTMModule]:
    """A recurrent Q-network of stock modules; its Q-values are called ``q``."""
    lstm = LSTMModule(HIDDEN, HIDDEN, in_key="features", out_key="memory")
    network = TensorDictSequential(
        TensorDictModule(MLP(2, HIDDEN, num_cells=[], activate_last_layer=True), ["observation"], ["features"]),
        lstm,
        TensorDictModule(MLP(HIDDEN, 2, num_cells=[HIDDEN]), ["memory"], ["q"]),
    )
    return network, lstm


def make_env(lstm: LSTMModule, num_envs: int) -> TransformedEnv:
    """An environment whose tensordict carries the LSTM's state.

    The primer adds the state, and ``InitTracker`` marks where episodes begin. Without them the LSTM would start every
    step from zero, without an error.
    """
    env = SerialEnv(num_envs, cartpole_without_velocities)
    return TransformedEnv(env, Compose(InitTracker(), RewardSum(), lstm.make_tensordict_primer()))


@torch.no_grad()
def greedy_return(env: TransformedEnv, policy: TensorDictSequential) -> float:
    """Mean return of the first episode in each environment."""
    env.set_seed(1)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        after = env.rollout(500, policy, break_when_any_done=False, break_when_all_done=True)["next"]
    first = after["done"].int().cumsum(1).cumsum(1) == 1
    return after["episode_reward"][first].mean().item()


def main() -> None:
    """Trains and prints the greedy return before and after."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--updates", type=int, default=2500)
    updates = parser.parse_args().updates
    torch.set_num_threads(1)
    torch.manual_seed(0)
    torchrl_logger.setLevel("WARNING")

    network, lstm = make_network()
    env, evaluation_env = make_env(lstm, NUM_ENVS), make_env(lstm, 10)
    action = env.action_spec_unbatched  # one policy for both numbers of environments
    choose = QValueModule(action_value_key="q", action_space="categorical", spec=action)
    explore = EGreedyModule(action, eps_init=1.0, eps_end=0.05, annealing_num_steps=updates * 16)
    policy = TensorDictSequential(network, choose, explore)

    loss = RecurrentDQNLoss(network, gamma=0.99, burn_in=0.5)  # without exploration
    loss.set_keys(action_value="q")  # reward, done, init, ... keep TorchRL's names
    target = SoftUpdate(loss, tau=0.01)
    optimizer = torch.optim.Adam(network.parameters(), lr=1e-3)

    # With num_envs the storage is [time, env]: slices continue over the collector's batches, but never from one
    # environment into another (in a flat storage they would, without an error).
    buffer = make_sequence_buffer(50_000, slice_len=SLICE_LEN, batch_size=BATCH_SIZE, num_envs=NUM_ENVS)
    stored = [
        "observation",
        "action",
        "is_init",
        ("collector", "traj_ids"),
    ]  # without the LSTM's state, which gets stale
    stored += [("next", key) for key in ("observation", "reward", "done", "terminated", "truncated")]

    print(f"return before: {greedy_return(evaluation_env, policy):.0f}")
    collector = Collector(env, policy, frames_per_batch=NUM_ENVS * STEPS, auto_register_policy_transforms=False)
    done, results = 0, {}
    for batch in collector:
        buffer.extend(batch.select(*stored))
        explore.step(batch.numel())
        for _ in range(4 if len(buffer) > 1000 else 0):
            results = loss(sample_sequences(buffer))
            optimizer.zero_grad()
            results["loss"].backward()
            torch.nn.utils.clip_grad_norm_(network.parameters(), 10.0)
            optimizer.step()
            target.step()
            done += 1
            if done % max(1, updates // 10) == 0:
                print(f"{done:6,} updates  loss {results['loss'].item():7.4f}  Q {results['q_value'].item():6.2f}")
        if done >= updates:
            break
    collector.shutdown(close_env=True)
    print(f"return after: {greedy_return(evaluation_env, policy):.0f} of 500")


if __name__ == "__main__":
    main()
