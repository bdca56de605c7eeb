"""What episodes bring: sums per episode while training, and greedy evaluation on fixed seeds."""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase, ExplorationType, set_exploration_type

from hdrqn_torchrl import keys

_SUMMED = {
    "return": keys.REWARD,
    "extrinsic": keys.EXTRINSIC_REWARD,
    "intrinsic": keys.INTRINSIC_REWARD,
    "success": keys.SUCCESS,
}


class EpisodeTracker:
    """Sums what happens in each of N environments and reports the episodes that end.

    Reported per episode: ``return``, ``extrinsic``, ``intrinsic`` (hierarchical agents), ``success`` (1 if the whole
    task was completed), ``in_order`` (share of subgoals reached in the proper order, i.e. with an extrinsic
    reward of at least 1) and ``steps``.
    """

    def __init__(self) -> None:
        self.sums: TensorDictBase | None = None  # [N]

    def add(self, after: TensorDictBase) -> TensorDictBase:
        """Takes one step of all environments (what the environment wrote, ``[N]``).

        Returns:
            The sums ``[N]`` up to and including this step; those of ended episodes are cleared afterwards.
        """
        step = {name: after.get(key).squeeze(-1).float() for name, key in _SUMMED.items() if key in after}
        step["in_order"] = (step["extrinsic"] >= 1.0).float() / after.get(keys.ATTAINED).shape[-1]
        step["steps"] = torch.ones_like(step["return"])
        sums = TensorDict(step, after.batch_size, device=after.device)
        if self.sums is not None:
            sums = sums + self.sums
        self.sums = sums * (~after.get(keys.DONE)).squeeze(-1).float()
        return sums

    def finished(self, batch: TensorDictBase) -> TensorDictBase:
        """Takes a collected batch ``[N, T]``; returns the episodes ``[M]`` that ended in it."""
        ended = []
        for after in batch.get("next").unbind(1):
            ended.append(self.add(after)[after.get(keys.DONE).squeeze(-1)])
        return torch.cat(ended, 0)

    def state_dict(self) -> dict[str, TensorDictBase | None]:
        """Sums of the episodes in progress."""
        return {"sums": self.sums}

    def load_state_dict(self, state: dict[str, TensorDictBase | None]) -> None:
        """Restores what :meth:`state_dict` returned."""
        self.sums = state["sums"]


@torch.no_grad()
def evaluate(
    env: EnvBase,
    policy: TensorDictModuleBase,
    *,
    episodes: int,
    seed: int = 0,
    exploration_type: ExplorationType = ExplorationType.DETERMINISTIC,
) -> dict[str, float]:
    """Plays ``episodes`` episodes and averages them; the same seed gives the same episodes.

    Every environment contributes the same number of episodes: taking the first that finish would favour short
    ones. (TorchRL's ``Evaluator`` does that, hence this function.)

    Args:
        env: environment with batch size ``[N]``.
        policy: greedy under the default ``exploration_type``.
        episodes: number of episodes, rounded up to a multiple of N.
        seed: seed of the environment.
        exploration_type: ``ExplorationType.RANDOM`` plays with the policy's current epsilon.

    Returns:
        ``return_mean``, ``extrinsic_mean``, ``intrinsic_mean``, ``success_rate`` (share of episodes that complete
        the whole task), ``in_order_rate`` (share of subgoals reached in the proper
        order), ``steps_mean``, ``episodes``.
    """
    env.set_seed(seed)
    with set_exploration_type(exploration_type), torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        rounds = [_play_once(env, policy) for _ in range(-(-episodes // env.batch_size[0]))]
    played: TensorDictBase = torch.cat(rounds, 0)  # type: ignore[assignment]
    return {
        "return_mean": _mean(played["return"]),
        "extrinsic_mean": _mean(played["extrinsic"]),
        "intrinsic_mean": _mean(played["intrinsic"]) if "intrinsic" in played else 0.0,
        "success_rate": _mean(played["success"]),
        "in_order_rate": _mean(played["in_order"]),
        "steps_mean": _mean(played["steps"]),
        "episodes": len(played),
    }


def _play_once(env: EnvBase, policy: TensorDictModuleBase) -> TensorDictBase:
    """One episode in each environment, ``[N]``."""
    tensordict, tracker = env.reset(), EpisodeTracker()
    playing = torch.ones(env.batch_size, dtype=torch.bool, device=tensordict.device)
    episodes: TensorDictBase | None = None
    while playing.any():
        tensordict, following = env.step_and_maybe_reset(policy(tensordict))
        after = tensordict.get("next")
        sums = tracker.add(after)
        ended = playing & after.get(keys.DONE).squeeze(-1)
        episodes = sums if episodes is None else torch.where(ended, sums, episodes)
        playing, tensordict = playing & ~ended, following
    assert episodes is not None
    return episodes


def _mean(values: Tensor) -> float:
    return values.mean().item()
