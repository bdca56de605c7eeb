"""Stored steps told anew: what their events attain, once other events are subgoals."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor

from hdrqn_torchrl import keys
from hdrqn_torchrl.discovery.table import EXPLORE, SubgoalTable


def relabel(steps: TensorDictBase, table: SubgoalTable, *, newest: int, kept: Tensor) -> None:
    """Rewrites, in place, which subgoals stored steps attained and could choose, as the environment would have.

    The steps in which an episode begins may have been overwritten; then what it had spent is read from its oldest step
    that is left. A subgoal that has another meaning now was not pursued in old steps; they count as exploring, where
    what was pursued is stored as such.

    Args:
        steps: a ring of steps ``[rows, N]`` with their ``events``.
        table: which subgoal each event is.
        newest: row that was written last.
        kept: subgoals that mean what they meant when the steps were last labelled, ``[G]`` bool.

    Examples:
        >>> from tensordict import TensorDict
        >>> flags, begins = torch.zeros(4, 1, 2).bool(), torch.tensor([[[True]], [[False]], [[False]], [[False]]])
        >>> after = {"events": torch.tensor([0, 7, 0, 7]).view(4, 1, 1), "attained": flags.clone()}
        >>> root = {"collector": {"traj_ids": torch.zeros(4, 1)}, "is_init": begins, "subgoal_mask": ~flags}
        >>> steps, table = TensorDict({**root, "next": after}, [4, 1]), SubgoalTable(1)
        >>> kept = table.assign({7: 1})
        >>> relabel(steps, table, newest=3, kept=kept)
        >>> steps["next", "attained"][..., 1].flatten()
        tensor([False,  True, False,  True])
    """
    order = (torch.arange(len(steps), device=steps.device) + newest + 1) % len(steps)  # oldest first
    after, episode = steps.get("next"), steps.get(keys.TRAJ_IDS)[order]
    attained = table.attained(after.get(keys.EVENTS)[order])  # [rows, N, G]
    begins = episode != episode.roll(1, 0)
    begins[0] = True
    before = _attained_before(attained, begins)
    mask = steps.get(keys.SUBGOAL_MASK)
    oldest = ~mask[order[0]] & ~steps.get(keys.IS_INIT)[order[0]] & kept  # [N, G]: spent already
    spent = before | ((episode == episode[0]).unsqueeze(-1) & oldest)
    mask[order] = table.available(spent)
    after.get(keys.ATTAINED)[order] = attained
    if (active := after.get(keys.ACTIVE_SUBGOAL, None)) is not None:
        active.masked_fill_(~kept[active], EXPLORE)


def _attained_before(attained: Tensor, begins: Tensor) -> Tensor:
    """What each episode has attained before each step, ``[rows, N, G]`` bool, from its first stored step on.

    Args:
        attained: in each step, the oldest first.
        begins: first stored step of an episode, ``[rows, N]`` bool.

    Examples:
        >>> attained = torch.tensor([True, False, True, False]).view(4, 1, 1)
        >>> begins = torch.tensor([True, False, False, True]).view(4, 1)
        >>> _attained_before(attained, begins).flatten().tolist()
        [False, True, True, False]
    """
    passed = attained.int().cumsum(0) - attained.int()  # before each step, since the oldest one
    time = torch.arange(len(begins), device=begins.device).unsqueeze(-1)
    first = torch.where(begins, time, 0).cummax(0).values  # [rows, N]
    return passed > passed.gather(0, first.unsqueeze(-1).expand_as(passed))
