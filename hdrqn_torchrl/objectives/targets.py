"""Q-learning targets and masks as pure functions of tensors.

``B`` sequences, ``T`` transitions, ``A`` actions. Everything is ``[B, T]`` unless said otherwise.
"""

from __future__ import annotations

import math

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
    return target.gather(-1, greedy_choice(online, mask).unsqueeze(-1)).squeeze(-1)


def greedy_choice(value: Tensor, mask: Tensor | None = None) -> Tensor:
    """The best action ``[*]`` by Q-values ``[*, A]`` among those that exist (``mask``, ``[*, A]`` bool).

    Examples:
        >>> greedy_choice(torch.tensor([[1.0, 3.0, 2.0]]), torch.tensor([[True, False, True]]))
        tensor([2])
    """
    return (value if mask is None else mask_values(value, mask)).argmax(-1)


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


def lambda_returns(
    reward: Tensor, ended: Tensor, next_value: Tensor, trace: Tensor, discount: Tensor | float
) -> Tensor:
    r"""Q(lambda) targets by a backward recursion:
    :math:`G_t = r_t + \gamma_t ((1 - \lambda_t) V_{t+1} + \lambda_t G_{t+1})`, and :math:`G_t = r_t` at an end.

    With Watkins' cut (:func:`watkins_trace`) it is Watkins' Q(lambda) (Sutton and Barto, section 12.10); along options,
    with :math:`\gamma^k` as discount, its SMDP form.

    Args:
        reward: ``[B, T, *]``.
        ended: bool; the return ends with this transition, what follows is not read.
        next_value: value of the state that follows.
        trace: how much of the next transition's own target is taken over, in [0, 1]. It must be 0 where the next
            transition does not continue this one; at the last step it is taken to be 0.
        discount: of what follows, a number or one per transition.

    Examples:
        >>> reward, nothing = torch.tensor([[0.0, 1.0]]), torch.tensor([[False, False]])
        >>> lambda_returns(reward, nothing, torch.tensor([[4.0, 8.0]]), torch.tensor([[0.5, 0.5]]), 0.5)
        tensor([[2.2500, 5.0000]])
    """
    discount = torch.as_tensor(discount, device=reward.device).expand_as(reward).masked_fill(ended, 0.0)
    kept = discount * trace
    # What does not depend on later targets, for all steps at once.
    target = reward + (discount - kept) * next_value.masked_fill(ended, 0.0)
    target[:, -1] = torch.addcmul(target[:, -1], kept[:, -1], next_value[:, -1].masked_fill(ended[:, -1], 0.0))
    steps = target.unbind(1)
    for now, following, share in zip(
        reversed(steps[:-1]), reversed(steps[1:]), reversed(kept.unbind(1)[:-1]), strict=True
    ):
        now.addcmul_(share, following)
    return target


def check_bounds(smallest: float | None, largest: float | None, *, names: tuple[str, str]) -> None:
    """Refuses bounds of targets that leave nothing between them.

    Args:
        smallest, largest: the bounds; ``None``: none.
        names: what they are called.

    Raises:
        ValueError: if the smallest is above the largest.

    Examples:
        >>> check_bounds(0.0, -1.0, names=("min_target", "max_target"))
        Traceback (most recent call last):
        ...
        ValueError: max_target must be >= min_target=0.0, got -1.0; they bound the return, or leave them out.
    """
    if smallest is not None and largest is not None and smallest > largest:
        raise ValueError(
            f"{names[1]} must be >= {names[0]}={smallest}, got {largest}; they bound the return, or leave them out."
        )


def check_returns(trace_decay: float, n_step: int) -> None:
    """Refuses lengths of targets that do not exist or contradict each other.

    Args:
        trace_decay: lambda.
        n_step: number of rewards.

    Raises:
        ValueError: if a value breaks its rule.

    Examples:
        >>> check_returns(trace_decay=0.8, n_step=1)
        >>> check_returns(trace_decay=0.0, n_step=0)
        Traceback (most recent call last):
        ...
        ValueError: n_step must be >= 1, got 0; 1 is the one-step target.
    """
    if not 0.0 <= trace_decay <= 1.0:
        raise ValueError(f"trace_decay must lie in [0, 1], got {trace_decay}; use 0.8, or 0 for one-step targets.")
    if n_step < 1:
        raise ValueError(f"n_step must be >= 1, got {n_step}; 1 is the one-step target.")
    if n_step > 1 and trace_decay > 0:
        raise ValueError(
            f"n_step must be 1 where trace_decay > 0, got n_step={n_step} and trace_decay={trace_decay}; Q(lambda) "
            "weighs targets of all lengths already: leave one of the two at its default."
        )


def target_lookahead(trace_decay: float, n_step: int, slice_len: int) -> int:
    r"""Steps that should follow a sequence of ``slice_len`` trained ones, so that no target is cut short by its end.

    An n-step target takes n - 1 of them. A target of Q(lambda) reaches over all that there are, with weights that fade;
    it takes :math:`\lambda / (1 - \lambda)` on average, which is the number drawn, but no more than ``slice_len``.

    Args:
        trace_decay: lambda.
        n_step: rewards of a target.
        slice_len: steps that may be trained.

    Examples:
        >>> target_lookahead(0.0, 1, 8), target_lookahead(0.0, 5, 8), target_lookahead(0.8, 1, 8)
        (0, 4, 4)
    """
    if not trace_decay:
        return n_step - 1
    if trace_decay == 1.0:
        return slice_len
    return min(slice_len, math.ceil(trace_decay / (1.0 - trace_decay) - 1e-6))


def watkins_trace(greedy: Tensor, trace_decay: float) -> Tensor:
    """Watkins' cut: a target takes over the next one only if the next action is the greedy one.

    Args:
        greedy: ``[B, T, *]`` bool, whether the action of each step is greedy.
        trace_decay: lambda.

    Returns:
        ``[B, T, *]``, the trace of each step for :func:`lambda_returns`: lambda where the next action is greedy.

    Examples:
        >>> watkins_trace(torch.tensor([[True, False, True]]), 0.5)
        tensor([[0.0000, 0.5000, 0.0000]])
    """
    following = torch.cat([greedy[:, 1:], torch.zeros_like(greedy[:, :1])], 1)
    return trace_decay * following.float()


def n_step_returns(
    reward: Tensor, ended: Tensor, next_value: Tensor, follows: Tensor, discount: Tensor | float, n: int
) -> Tensor:
    r"""n-step targets :math:`r_t + \gamma r_{t+1} + ... + \gamma^n V_{t+n}`, shorter where a sequence ends or breaks.

    Args:
        reward, ended, next_value, discount: as in :func:`lambda_returns`.
        follows: bool; whether the next transition continues this one. Where it does not, the value is taken.
        n: number of rewards, >= 1.

    Examples:
        >>> reward, no = torch.ones(1, 3), torch.zeros(1, 3, dtype=torch.bool)
        >>> n_step_returns(reward, no, torch.full((1, 3), 8.0), ~no, 0.5, 2)
        tensor([[3.5000, 3.5000, 5.0000]])
    """
    if n < 1:
        raise ValueError(f"n must be >= 1 step, got {n}; use 1 for the one-step target.")
    discount = torch.as_tensor(discount, device=reward.device).expand_as(reward).masked_fill(ended, 0.0)
    value = next_value.masked_fill(ended, 0.0)
    shorter = reward + discount * value
    follows = torch.cat([follows[:, :-1], torch.zeros_like(follows[:, :1])], 1)
    for _ in range(n - 1):
        following = torch.cat([shorter[:, 1:], shorter[:, -1:]], 1)
        shorter = reward + discount * torch.where(follows, following, value)
    return shorter


def sequence_priority(error: Tensor, trained: Tensor, largest: float = 0.9) -> Tensor:
    """Priority of replayed sequences: a mixture of their largest and their mean absolute TD error.

    Args:
        error: TD errors ``[B, T, *]``.
        trained: bool, which of them count.
        largest: share of the largest one; 0.9 is R2D2's (Kapturowski et al., 2019).

    Returns:
        ``[B]``; 0 where nothing counts.

    Examples:
        >>> sequence_priority(torch.tensor([[-1.0, 0.0, 9.0]]), torch.tensor([[True, True, False]]))
        tensor([0.9500])
    """
    error, trained = error.abs().masked_fill(~trained, 0.0).flatten(1), trained.flatten(1)
    mean = error.sum(1) / trained.sum(1).clamp(min=1)
    return largest * error.amax(1) + (1 - largest) * mean


def importance_weight(weight: Tensor) -> Tensor:
    """Weights of sequences in a loss, relative to the largest of the minibatch (Schaul et al., 2016).

    Args:
        weight: the same at all steps of a sequence, ``[B, T]``.

    Returns:
        ``[B]``.

    Examples:
        >>> importance_weight(torch.tensor([[0.5, 0.5, 0.5], [2.0, 2.0, 2.0]]))
        tensor([0.2500, 1.0000])
    """
    return weight[:, 0] / weight[:, 0].max()


def training_mask(valid: Tensor, init: Tensor, burn_in: float, train_exact_states: bool, lookahead: int = 0) -> Tensor:
    """Which steps of sequences enter the loss (the paper: the last half).

    The state at the first steps of a sequence lacks the history before the slice, or was stored by older weights. It
    is exact from the first step on at which acting, too, restarted from zero.

    Args:
        valid: steps that are not padding; padding only follows valid steps.
        init: steps before which the recurrent state restarts from zero in acting.
        burn_in: share of each sequence, rounded down to steps, that is left out at its beginning.
        train_exact_states: whether leading steps whose state is exact are trained nevertheless. Without it a short
            trajectory's first steps are never trained.
        lookahead: steps at the end that the targets of others need and that are not part of the sequence.

    Returns:
        bool mask.

    Examples:
        >>> valid, init = torch.ones(1, 4, dtype=torch.bool), torch.tensor([[False, True, False, False]])
        >>> training_mask(valid, init, burn_in=0.75, train_exact_states=True)
        tensor([[False,  True,  True,  True]])
    """
    length = valid.shape[-1] - lookahead
    step = torch.arange(valid.shape[-1], device=valid.device)
    mask = (step >= int(length * burn_in)).expand_as(valid)
    if train_exact_states:
        mask = mask | (init.cumsum(-1) > 0)
    return mask & valid & (step < length)
