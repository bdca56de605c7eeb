r"""hDRQNv3's loss: every subgoal and both levels learn from every step.

Sub level, for each subgoal g, whichever was pursued:

.. math:: r^g_t = 1[g\ attained] + r_{wrong} 1[another\ attained] + r_{hazard} 1[hazard],
          \quad y^g_t = r^g_t + \gamma_S (1 - e^g_t) ((1 - \lambda_t) V^g(s_{t+1}) + \lambda_t y^g_{t+1})

where :math:`e^g_t` is the end of the episode or of the subgoal, and :math:`\lambda_t` is lambda where the next action
is greedy for g, else 0 (Watkins' cut). Meta level, by intra-option learning (Sutton, Precup and Singh, 1998): a step
belongs to every option that would have taken its action, and to the one pursued,

.. math:: y_t(g) = r^{ex}_t + \gamma_M U_{t+1}(g)

with :math:`U(g) = \max_{g'} Q^M(s', g')` where g was attained, else :math:`(1 - \lambda_t) Q^M(s', g) + \lambda_t
y_{t+1}(g)`. So the meta level, too, learns from every step and not only from those at which options begin. Without
intra-option learning it learns where options begin only, from what the option brought (SMDP),

.. math:: y = r^{ex}_0 + \gamma_M r^{ex}_1 + \dots + \gamma_M^k ((1 - \lambda') \max_{g'} Q^M(s_k, g') + \lambda' y_k)

with :math:`\lambda'` = lambda where the next subgoal is the greedy one, else 0.

Memory: if the network has a predictor, it is also trained to tell what the next few steps will show.
"""

from __future__ import annotations

import math
from copy import deepcopy
from dataclasses import dataclass
from typing import Literal

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase, TensorDictParams
from tensordict.utils import unravel_key
from torch import Tensor
from torchrl.modules import set_recurrent_mode
from torchrl.objectives import LossModule
from torchrl.objectives.utils import distance_loss

from hdrqn_torchrl import keys
from hdrqn_torchrl.modules import AllSubgoalsPolicy
from hdrqn_torchrl.modules.exploration import mask_values
from hdrqn_torchrl.objectives.prediction import prediction_loss
from hdrqn_torchrl.objectives.targets import (
    double_q_value,
    importance_weight,
    lambda_returns,
    sequence_priority,
    training_mask,
    watkins_trace,
)
from hdrqn_torchrl.transforms import IntrinsicReward


class AllSubgoalsLoss(LossModule):
    """Trains an :class:`~hdrqn_torchrl.modules.AllSubgoalsPolicy` on sequences ``[B, T + lookahead]`` of steps.

    The last step only values what the one before led to, so that no observation is stored twice. Sequences may run
    on through ends of episodes; each should begin where an episode does, because the memory starts empty, unless it
    starts from what was stored (``stored_state``). Steps
    after a sequence's end are padding (``mask``): they contribute nothing, and what the last real step led to is
    unknown unless it ended the episode. ``priority`` tells what is left to learn from each sequence, of both levels
    together, ``[B]``.

    Args:
        policy: network and keys.
        sub_gamma: discount of the sub level. A low one makes haste pay: of two ways, the shorter stands out.
        meta_gamma: discount of the meta level, per environment step.
        trace_decay: lambda.
        reached_reward, wrong_subgoal_reward, hazard_reward: of the sub level, for attaining the subgoal, attaining
            another one, meeting the hazard (which is not read if that is 0).
        double: Double Q-learning.
        all_subgoals: ``False``: only the subgoal that was pursued learns, at both levels.
        intra_option: ``False``: the meta level learns from the steps at which options begin only, and of those whose
            end is in the sequence. (``True`` takes options to last until their subgoal is attained: a step limit of
            options is not seen.)
        max_meta_target, min_meta_target: largest and smallest return of the task there can be, if known; the meta
            level's targets are kept between them.
        burn_in, train_exact_states: which steps enter the loss, see :func:`~hdrqn_torchrl.objectives.training_mask`;
            in sequences that begin where an episode does, every state is exact.
        lookahead: steps at the end of each sequence that are not trained: the last one, and before it those that are
            there for the targets of others (:func:`~hdrqn_torchrl.objectives.target_lookahead`).
        loss_function: ``"l2"`` or ``"smooth_l1"`` (Huber).
        stored_state: sequences start from the LSTM state that acting had at their first step, in both networks, and
            from zero where an episode starts.
        prediction_weight: of the error of the network's predictor, if it has one; how many steps ahead it looks is
            drawn anew for every minibatch.

    Raises:
        ValueError: if an argument breaks its rule.

    Examples:
        See :func:`hdrqn_torchrl.algorithms.make_v3`, which builds one.
    """

    @dataclass
    class _AcceptedKeys:
        action: NestedKey = keys.ACTION
        attained: NestedKey = keys.ATTAINED
        hazard: NestedKey = keys.HAZARD
        extrinsic_reward: NestedKey = keys.EXTRINSIC_REWARD
        done: NestedKey = keys.DONE
        terminated: NestedKey = keys.TERMINATED
        active_subgoal: NestedKey = keys.ACTIVE_SUBGOAL
        option_init: NestedKey = keys.OPTION_INIT
        mask: NestedKey = keys.PAD_MASK
        priority_weight: NestedKey = "priority_weight"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys
    policy: AllSubgoalsPolicy
    policy_params: TensorDictParams
    target_policy_params: TensorDictParams
    out_keys = [
        "loss",
        "sub_loss",
        "meta_loss",
        "td_error",
        "meta_td_error",
        "q_value",
        "target",
        "meta_q_value",
        "trained_steps",
        "priority",
    ]

    def __init__(
        self,
        policy: AllSubgoalsPolicy,
        *,
        sub_gamma: float = 0.95,
        meta_gamma: float = 0.97,
        trace_decay: float = 0.8,
        reached_reward: float = 1.0,
        wrong_subgoal_reward: float = 0.0,
        hazard_reward: float = -1.0,
        double: bool = True,
        all_subgoals: bool = True,
        intra_option: bool = True,
        max_meta_target: float = math.inf,
        min_meta_target: float = -math.inf,
        burn_in: float = 0.0,
        train_exact_states: bool = True,
        lookahead: int = 1,
        loss_function: Literal["l2", "smooth_l1"] = "l2",
        stored_state: bool = False,
        prediction_weight: float = 0.1,
    ) -> None:
        if prediction_weight < 0.0:
            raise ValueError(f"prediction_weight must be >= 0, got {prediction_weight}; use 0.1, or no predictor.")
        for name, value in (("sub_gamma", sub_gamma), ("meta_gamma", meta_gamma), ("trace_decay", trace_decay)):
            if not 0.0 <= value <= 1.0:
                raise ValueError(f"{name} must lie in [0, 1], got {value}; the defaults are 0.95, 0.97 and 0.8.")
        if not 0.0 <= burn_in < 1.0:
            raise ValueError(f"burn_in must lie in [0, 1), got {burn_in}; use 0 for sequences from an episode's start.")
        if loss_function not in ("l2", "smooth_l1"):
            raise ValueError(f"loss_function must be 'l2' or 'smooth_l1', got {loss_function!r}; the default is 'l2'.")
        if lookahead < 1:
            raise ValueError(f"lookahead must be >= 1 step, got {lookahead}; the last one is never trained.")
        super().__init__()
        self.convert_to_functional(policy, "policy", create_target_params=True)
        # As in RecurrentDQNLoss: the modules as they are called, outside the module tree.
        target = deepcopy(policy)
        self._modules["target_policy_params"].to_module(target, preserve_module_state=False)
        self.__dict__["_policies"] = (policy, target)
        self.sub_gamma, self.meta_gamma, self.trace_decay = sub_gamma, meta_gamma, trace_decay
        self.rewards = IntrinsicReward(reached=reached_reward, hazard=hazard_reward, wrong_subgoal=wrong_subgoal_reward)
        self.double = double
        self.all_subgoals, self.intra_option = all_subgoals, intra_option
        self.max_meta_target, self.min_meta_target = max_meta_target, min_meta_target
        self.max_sub_target = self.rewards.largest_return
        self.burn_in, self.train_exact_states, self.loss_function = burn_in, train_exact_states, loss_function
        self.lookahead = lookahead
        self.state_keys = list(policy.state_keys) if stored_state else []
        self.prediction_weight = prediction_weight
        if self._predicts:
            self.out_keys = [*self.out_keys, "prediction_loss"]

    def _forward_value_estimator_keys(self, **kwargs) -> None:
        """The keys are read at every call; nothing to pass on."""

    @property
    def in_keys(self) -> list[NestedKey]:
        policy, k = self._policies[0], self.tensor_keys
        read = [policy.observation_key, policy.previous_action_key, policy.init_key, policy.mask_key, k.action]
        read += self.state_keys
        nexts = [k.attained, k.extrinsic_reward, k.done, k.terminated, k.active_subgoal]
        nexts += [k.hazard] if self.rewards.hazard else []
        return [*read, k.option_init, *(unravel_key(("next", key)) for key in nexts)]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        online, target, memory = self._values(tensordict)
        steps, valid = tensordict[:, :-1], self._valid(tensordict)
        events = self._events(steps, valid)
        with torch.no_grad():
            sub_target, meta_target, agrees = self._targets(online, target, tensordict, events)
        action = steps[self.tensor_keys.action][..., None, None].expand(*events["attained"].shape, 1)
        sub_value = online[0][:, :-1].gather(-1, action).squeeze(-1)  # [B, T, G]
        meta_value = online[1][:, :-1]
        sub_steps, meta_steps = self._trained(tensordict, valid[:, :-1], events, agrees)
        weight = tensordict.get(self.tensor_keys.priority_weight, None)
        sub_loss = self._distance(sub_value, sub_target, sub_steps, weight)
        meta_loss = self._distance(meta_value, meta_target, meta_steps, weight)
        with torch.no_grad():
            report = {
                "td_error": _masked_mean((sub_value - sub_target).abs(), sub_steps),
                "meta_td_error": _masked_mean((meta_value - meta_target).abs(), meta_steps),
                "q_value": _masked_mean(sub_value, sub_steps),
                "target": _masked_mean(sub_target, sub_steps),
                "meta_q_value": _masked_mean(meta_value, meta_steps),
                "trained_steps": sub_steps.sum(),
                "priority": sequence_priority(
                    torch.cat([sub_value - sub_target, meta_value - meta_target], -1),
                    torch.cat([sub_steps, meta_steps], -1),
                ),
            }
        losses = {"loss": sub_loss + meta_loss, "sub_loss": sub_loss.detach(), "meta_loss": meta_loss.detach()}
        if self._predicts:
            prediction_error = self._prediction_loss(memory, tensordict, valid)
            losses["loss"] = losses["loss"] + self.prediction_weight * prediction_error
            losses["prediction_loss"] = prediction_error.detach()
        return TensorDict({**losses, **report}, [])

    @property
    def _predicts(self) -> bool:
        return self._policies[0].network.predictor is not None and self.prediction_weight > 0.0

    def _prediction_loss(self, memory: Tensor, tensordict: TensorDictBase, valid: Tensor) -> Tensor:
        """Mean error of predictions within an episode."""
        policy = self._policies[0]
        return prediction_loss(
            policy.network.predictor,
            memory,
            tensordict[self.tensor_keys.action],
            tensordict[policy.observation_key],
            valid=valid,
            cut=tensordict[policy.init_key].squeeze(-1)[:, 1:],
        )

    def _values(self, tensordict: TensorDictBase) -> tuple[tuple[Tensor, Tensor], tuple[Tensor, Tensor], Tensor]:
        """Q-values of both levels, ``[B, T + 1, G, A]`` and ``[B, T + 1, G]``, by main and target network; the main
        network's memory ``[B, T + 1, H]``."""
        policy, target_policy = self._policies
        read = (policy.observation_key, policy.previous_action_key, policy.init_key, policy.mask_key)
        inputs = tensordict.select(*read, *self.state_keys)

        def run(which: AllSubgoalsPolicy) -> tuple[Tensor, Tensor, Tensor]:
            values = which(inputs.copy())
            written = (which.action_value_key, which.subgoal_value_key, which.hidden_key)
            return tuple(values.get(key) for key in written)  # type: ignore[return-value]

        with set_recurrent_mode(True):
            with torch.no_grad():
                target = run(target_policy)[:2]
            *online, memory = run(policy)
            return tuple(online), target, memory  # type: ignore[return-value]

    def _valid(self, tensordict: TensorDictBase) -> Tensor:
        """Which steps are no padding, ``[B, T + 1]`` bool."""
        mask = tensordict.get(self.tensor_keys.mask, None)
        return torch.ones(tensordict.shape, dtype=torch.bool, device=tensordict.device) if mask is None else mask

    def _events(self, steps: TensorDictBase, valid: Tensor) -> dict[str, Tensor]:
        """What each step ``[B, T]`` led to, as far as it does not depend on values."""
        k, after = self.tensor_keys, steps["next"]
        attained = after[k.attained]
        done, terminated = after[k.done].squeeze(-1), after[k.terminated].squeeze(-1)
        last = valid[:, :-1] & ~valid[:, 1:]  # before padding
        reward = self.rewards.of_all(attained, after[k.hazard] if self.rewards.hazard else None)
        return {
            "attained": attained,
            "sub_reward": reward,
            "extrinsic_reward": after[k.extrinsic_reward].expand_as(reward),
            "sub_end": attained | terminated.unsqueeze(-1),
            "meta_end": terminated.unsqueeze(-1).expand_as(attained),
            # Cut off by a time limit, or by the sequence's end: what follows is not in the sequence.
            "unseen": ((done | last) & ~terminated).unsqueeze(-1).expand_as(attained),
        }

    def _targets(
        self,
        online: tuple[Tensor, Tensor],
        target: tuple[Tensor, Tensor],
        tensordict: TensorDictBase,
        events: dict[str, Tensor],
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Targets of both levels ``[B, T, G]``, and whether each option agrees with the action, ``[B, T, G]`` bool."""
        mask = tensordict[self._policies[0].mask_key]
        chooser = online if self.double else target
        sub_next = double_q_value(chooser[0], target[0])[:, 1:]
        best_next = double_q_value(chooser[1], target[1], mask)[:, 1:].unsqueeze(-1).expand_as(sub_next)
        agrees = online[0].argmax(-1) == tensordict[self.tensor_keys.action].unsqueeze(-1)  # [B, T + 1, G]
        trace = watkins_trace(agrees, self.trace_decay)[:, :-1].masked_fill(events["unseen"], 0.0)
        if self.intra_option:
            meta_next = torch.where(events["attained"], best_next, target[1][:, 1:])
            meta_trace = trace.masked_fill(events["attained"], 0.0)
        else:
            meta_next, meta_trace = best_next, self._option_trace(online[1], tensordict, events)
        # One recursion serves both levels, as columns beside each other.
        unseen = torch.cat([events["unseen"] & ~events["attained"], events["unseen"]], -1)
        trace = torch.cat([trace, meta_trace], -1)
        trace[:, :-1].masked_fill_(unseen[:, 1:], 0.0)  # there is no target to take over
        reward = torch.cat([events["sub_reward"], events["extrinsic_reward"]], -1)
        ended = torch.cat([events["sub_end"], events["meta_end"]], -1) | unseen
        discount = torch.ones_like(sub_next)
        discount = torch.cat([self.sub_gamma * discount, self.meta_gamma * discount], -1)
        following = torch.cat([sub_next, meta_next], -1)
        returns = lambda_returns(reward, ended, following, trace, discount)
        sub_target, meta_target = returns.chunk(2, -1)
        meta_target = meta_target.clamp(min=self.min_meta_target, max=self.max_meta_target)
        return sub_target.clamp(max=self.max_sub_target), meta_target, agrees[:, :-1]

    def _option_trace(self, subgoal_value: Tensor, tensordict: TensorDictBase, events: dict[str, Tensor]) -> Tensor:
        """Traces ``[B, T, G]`` along options: all inside them; lambda to the next one, if it is the greedy choice and
        seen to its end."""
        k = self.tensor_keys
        greedy = mask_values(subgoal_value, tensordict[self._policies[0].mask_key]).argmax(-1)
        agrees = greedy == tensordict["next", k.active_subgoal]
        to_next = watkins_trace(agrees, self.trace_decay)[:, :-1]
        to_next[:, :-1] *= self._ends_in_sequence(tensordict, events)[:, 1:].squeeze(-1)
        trace = torch.where(tensordict[k.option_init].squeeze(-1)[:, 1:], to_next, 1.0)
        return trace.unsqueeze(-1).repeat(1, 1, subgoal_value.shape[-1])

    def _trained(
        self, tensordict: TensorDictBase, valid: Tensor, events: dict[str, Tensor], agrees: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Which entries ``[B, T, G]`` enter the losses of the sub level and of the meta level."""
        k, policy, steps = self.tensor_keys, self._policies[0], tensordict[:, :-1]
        init = steps[policy.init_key].squeeze(-1)
        warm = training_mask(valid, init, self.burn_in, self.train_exact_states, self.lookahead - 1)  # [B, T]
        left = steps[policy.mask_key] & warm.unsqueeze(-1)
        pursued = steps["next", k.active_subgoal].unsqueeze(-1) == torch.arange(left.shape[-1], device=left.device)
        sub_steps = left & (~events["unseen"] | events["attained"])
        meta_steps = left & ~events["unseen"] & (agrees | pursued)
        if not self.all_subgoals:
            sub_steps, meta_steps = sub_steps & pursued, meta_steps & pursued
        if not self.intra_option:
            whole = self._ends_in_sequence(tensordict, events)
            meta_steps = meta_steps & pursued & steps[k.option_init] & whole
        return sub_steps, meta_steps

    def _ends_in_sequence(self, tensordict: TensorDictBase, events: dict[str, Tensor]) -> Tensor:
        """Steps ``[B, T, 1]`` whose option ends within the sequence, what it led to included."""
        seen = ~events["unseen"][..., :1]
        ends = (tensordict[self.tensor_keys.option_init][:, 1:] | events["meta_end"][..., :1]) & seen
        found = [torch.zeros_like(ends[:, 0])]
        for end, visible in zip(reversed(ends.unbind(1)), reversed(seen.unbind(1)), strict=True):
            found.append(end | (found[-1] & visible))
        return torch.stack(found[:0:-1], 1)

    def _distance(self, value: Tensor, target: Tensor, mask: Tensor, weight: Tensor | None) -> Tensor:
        """Mean loss over ``mask``; sequences drawn by priority have a ``weight`` ``[B, T]``."""
        error = (value - target).masked_fill(~mask, 0.0)
        distance = distance_loss(error, torch.zeros_like(error), self.loss_function)
        if weight is not None:
            distance = distance * importance_weight(weight)[:, None, None]
        return distance.sum() / mask.sum().clamp(min=1)


def _masked_mean(value: Tensor, mask: Tensor) -> Tensor:
    return value.masked_fill(~mask, 0.0).sum() / mask.sum().clamp(min=1)
