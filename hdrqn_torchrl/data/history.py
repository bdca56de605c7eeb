"""Observations of whole options, from which v2's stored states can be recomputed (refreshed)."""

from __future__ import annotations

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.utils import unravel_key
from torch import Tensor

from hdrqn_torchrl import keys
from hdrqn_torchrl.modules import SubController

HISTORY, HISTORY_STEPS, HISTORY_SUBGOAL = "history", "history_steps", "history_subgoal"


class OptionHistory:
    """Gathers what each of N environments observed during its option in progress, across batches.

    Args:
        max_steps: L; a longer option keeps its first L observations, which then can't be used.
        observation_key: what is gathered.

    Examples:
        >>> from tensordict import TensorDict
        >>> seen = torch.tensor([[10, 11, 12, 13]])  # by one environment
        >>> batch = TensorDict({"observation": seen, "next": {"observation": seen + 1}}, [1, 4])
        >>> started, ended = torch.tensor([[True, False, False, True]]), torch.tensor([[False, False, True, False]])
        >>> OptionHistory(max_steps=3)(batch, started, ended)
        tensor([[10, 11, 12, 13]])
    """

    def __init__(self, max_steps: int, observation_key: NestedKey = keys.OBSERVATION) -> None:
        if max_steps < 1:
            raise ValueError(f"max_steps must be >= 1, got {max_steps}; use the step limit of an episode.")
        self.max_steps, self.observation_key = max_steps, observation_key
        self.reset()

    def reset(self) -> None:
        """Forgets the options in progress."""
        self._seen: Tensor | None = None  # [N, L + 1, ...]
        self._place: Tensor | None = None  # [N]

    def __call__(self, batch: TensorDictBase, started: Tensor, ended: Tensor) -> Tensor:
        """Takes a batch ``[N, T]`` with the starts and ends ``[N, T]`` of its options.

        Returns:
            For each end, by environment and then by time, the option's observations and the one that it ended in,
            ``[M, L + 1, ...]``; what follows is undefined.
        """
        observation = batch.get(self.observation_key)
        following = batch.get(unravel_key(("next", self.observation_key)))
        if self._seen is None or self._place is None:
            self._seen = observation.new_zeros((len(observation), self.max_steps + 1, *observation.shape[2:]))
            self._place = torch.full_like(started[:, 0], -1, dtype=torch.int64)
        environment = torch.arange(len(observation), device=observation.device)
        kept = [self._seen[:0]]
        for time in range(observation.shape[1]):
            self._place = torch.where(started[:, time], 0, self._place + 1)
            self._seen[environment, self._place.clamp(max=self.max_steps)] = observation[:, time]
            rows = ended[:, time].nonzero().squeeze(-1)
            histories = self._seen[rows]
            last = (self._place[rows] + 1).clamp(max=self.max_steps)
            histories[torch.arange(len(rows), device=rows.device), last] = following[rows, time]
            kept.append(histories)
        end_time, end_environment = ended.t().nonzero(as_tuple=True)  # in the order of `kept`
        return torch.cat(kept)[(end_environment * ended.shape[1] + end_time).argsort()]

    def state_dict(self) -> dict[str, Tensor | None]:
        """Observations of the options in progress."""
        seen = None if self._seen is None else self._seen.clone()  # it is written in place
        return {"seen": seen, "place": self._place}

    def load_state_dict(self, state: dict[str, Tensor | None]) -> None:
        """Restores what :meth:`state_dict` returned."""
        seen = state["seen"]
        self._seen, self._place = None if seen is None else seen.clone(), state["place"]


@torch.no_grad()
def refresh_hidden(
    sub_controller: SubController, max_steps: int, sample: TensorDictBase, *, read_last_observation: bool = False
) -> TensorDictBase:
    """Recomputes the sub-controller's states in option transitions with its present weights.

    Args:
        sub_controller: whose states they are.
        max_steps: L of :class:`OptionHistory`; states after longer options stay as they were stored.
        sample: rows ``[B, T]`` of an ``OptionExtractor(history=...)``.
        read_last_observation: whether the states include the observation in which the option ended.

    Returns:
        ``sample``, with new states where the option before ended.

    Examples:
        >>> from tensordict import TensorDict
        >>> from hdrqn_torchrl.modules import FullyConnectedFeatures, QNetwork
        >>> network = QNetwork(FullyConnectedFeatures(3, (8,)), num_actions=4, hidden_size=8, num_conditions=2)
        >>> rows = TensorDict({"sub_hidden": torch.zeros(1, 2, 8), "history": torch.rand(1, 2, 5, 3)}, [1, 2])
        >>> rows["history_steps"], rows["history_subgoal"] = torch.tensor([[[0], [4]]]), torch.tensor([[0, 1]])
        >>> refresh_hidden(SubController(network), 4, rows)["sub_hidden"].any(-1)
        tensor([[False,  True]])
    """
    steps = sample.get(HISTORY_STEPS).squeeze(-1).flatten()  # [B * T]; 0: the episode starts, the state is zero
    rows = ((steps > 0) & (steps <= max_steps)).nonzero().squeeze(-1)
    if not len(rows):
        return sample
    lengths = steps[rows] + int(read_last_observation)
    histories = sample.get(HISTORY).flatten(0, 1)[rows][:, : int(lengths.max())]
    subgoals = sample.get(HISTORY_SUBGOAL).flatten()[rows].unsqueeze(-1).expand(histories.shape[:2])
    state_keys = sub_controller.hidden_key, sub_controller.cell_key
    states = sub_controller.network.final_state(histories, subgoals, lengths)
    for key, state in zip(state_keys, states, strict=True):
        if (stored := sample.get(key, None)) is not None:
            sample.set(key, stored.flatten(0, 1).index_copy(0, rows, state).view_as(stored))
    return sample
