"""Q-learning targets and masks as pure functions of tensors.

``B`` sequences, ``T`` transitions, ``A`` actions. Everything is ``[B, T]`` unless said otherwise.
"""

from __future__ import annotations

import torch
from torch import Tensor

from hdrqn_torchrl.modules.exploration import mask_values


def double_q_value(online: Tensor, target: Tensor, mask: Tensor | None = None) -> Tensor:
    r"""Value of a state by Double Q-learning: :math:`Q'(s, \arg\max_a Q(s, a))`.

    Args:
        online: Q-values of the main network, ``[*, A]``; chooses the action.
        target: Q-values of the target network, ``[*, A]``; values it.
        mask: actions that exist, ``[*, A]`` bool.

    Returns:
        ``[*]``.

    Examples:
        >>> double_q_value(torch.tensor([1.0, 2.0]), torch.tensor([5.0, 3.0]))
        tensor(3.)
    """
    choice = online if mask is None else mask_values(online, mask)
    return target.gather(-1, choice.argmax(-1, keepdim=True)).squeeze(-1)


def smdp_target(
    reward: Tensor, terminated: Tensor, next_value: Tensor, gamma: Tensor | float, steps: Tensor | None = None
) -> Tensor:
    r"""One-step target over an option: :math:`y = r + \gamma^k V(s')`, and :math:`y = r` at a terminal state.

    Args:
        reward: what the transition collected.
        terminated: bool; ``next_value`` is not read there, whatever it holds.
        next_value: value of the state that follows.
        gamma: discount of one environment step.
        steps: environment steps k that the transition lasted; ``None`` is 1.

    Examples:
        >>> smdp_target(torch.tensor(1.0), torch.tensor(False), torch.tensor(4.0), 0.5, torch.tensor(2))
        tensor(2.)
    """
    discount = gamma if steps is None else gamma**steps
    return reward + (discount * next_value).masked_fill(terminated, 0.0)


def training_mask(valid: Tensor, init: Tensor, burn_in: float, train_exact_states: bool) -> Tensor:
    """Which steps of zero-start sequences enter the loss (the paper: the last half).

    The state at the first steps of a sequence lacks the history before the slice. It is exact from the first
    step on at which acting, too, restarted from zero.

    Args:
        valid: steps that are not padding; padding only follows valid steps.
        init: steps before which the recurrent state restarts from zero in acting.
        burn_in: share of each sequence, rounded down to steps, that is left out at its beginning.
        train_exact_states: whether leading steps whose state is exact are trained nevertheless. Without it a short
            trajectory's first steps are never trained.

    Returns:
        bool mask.

    Examples:
        >>> valid, init = torch.ones(1, 4, dtype=torch.bool), torch.tensor([[False, True, False, False]])
        >>> training_mask(valid, init, burn_in=0.75, train_exact_states=True)
        tensor([[False,  True,  True,  True]])
    """
    length = valid.shape[-1]
    mask = (torch.arange(length, device=valid.device) >= int(length * burn_in)).expand_as(valid)
    if train_exact_states:
        mask = mask | (init.cumsum(-1) > 0)
    return mask & valid
