r"""hDRQNv3's loss: every subgoal and every level learn from every step.

Level l chooses among :math:`X_l` (actions at level 0, else subgoals) and pursues some c of :math:`C_l = X_{l+1}`; the
top level pursues the task. For every level, every c and every choice x that agrees with step t, the target is

.. math:: y_l(c, x) = r_l(c) + \gamma_l (1 - e_l(c)) ((1 - \lambda_t) U_l(c, x) + \lambda_t y_l(c, x)_{t+1})

- reward :math:`r_l(c)`: at the top the task's extrinsic reward; below, the critic's reward for c
  (:class:`~hdrqn_torchrl.transforms.SubgoalTransform`, rule 3);
- end :math:`e_l(c)`: the episode terminated or, below the top, c was attained or lost (it can't be chosen any more);
- :math:`U = \max_{x'} Q_l(s', c, x')` (Double, over what can be chosen) if x was attained or lost in this step, which
  always holds for an action; else :math:`Q_l(s', c, x)`, as the option goes on;
- :math:`\lambda_t` is lambda if the next step agrees with x, else 0 (Watkins' cut); a subgoal's trace ends where it
  is attained or lost;
- an action agrees with a step if it was taken; a subgoal x agrees if the greedy choice of the level below for x does.
  x learns from the steps that it agrees with (intra-option learning; Sutton, Precup and Singh, 1998), and from those in
  which it was pursued, where it can be chosen. Where no subgoal can be chosen any is, and all of them learn.

So every level learns from every step, not only from those at which its options begin. Without intra-option learning,
levels above the first learn only from the first step of each option, with the rewards of the whole option (SMDP):

.. math:: y = r_0 + \gamma r_1 + \ldots + \gamma^k ((1 - \lambda') \max_{x'} Q(s_k, x') + \lambda' y_k)

with :math:`\lambda'` = lambda if the next subgoal is the greedy one, else 0. Where the sequence breaks off within an
option, :math:`Q'(s_k, x)` stands in: without options that do not end, all would seem to succeed.

If the network has a predictor, the memory is also trained to predict the observations of the next few steps.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase, TensorDictParams
from tensordict.utils import unravel_key
from torch import Tensor
from torchrl.modules import set_recurrent_mode

from hdrqn_torchrl import keys
from hdrqn_torchrl.modules import AllSubgoalsPolicy
from hdrqn_torchrl.objectives.base import SequenceLoss, masked_mean
from hdrqn_torchrl.objectives.level_targets import Columns, LevelTargets, StepEvents, make_rules
from hdrqn_torchrl.objectives.targets import check_bounds, lambda_returns, sequence_priority

Values = tuple[Tensor, ...]


class AllSubgoalsLoss(SequenceLoss):
    """Trains an :class:`~hdrqn_torchrl.modules.AllSubgoalsPolicy` on sequences ``[B, T + lookahead]`` of steps.

    The last step only serves to evaluate the outcome of the step before, so that no observation is stored twice.
    Sequences may continue past the end of an episode. Each should start at the start of an episode, because the memory
    starts empty, unless ``stored_state`` is set. Steps after the end of a sequence are padding (``mask``) and
    contribute nothing; the outcome of the last real step is unknown unless it ended the episode. ``priority`` ``[B]``
    measures how much is left to learn from each sequence, over all levels.

    Args:
        policy: network and keys.
        sub_gamma: discount of level 0. A low discount makes the shorter of two ways stand out.
        meta_gamma: discount of the top level, per environment step.
        middle_gamma: discount of the levels in between; ``None``: ``meta_gamma``.
        trace_decay: lambda.
        reached_reward: reward of the levels below the top for attaining their subgoal.
        hazard_reward: reward of the same levels for meeting the hazard; 0: the hazard is not read.
        wrong_subgoal_reward: reward of the same levels for attaining another subgoal of the same set; one number for
            the farthest set, or one for each set from near to far.
        bonus_reward: for agents of one level, which have no critic: added to the task's reward for each subgoal
            attained in a step (key ``bonus``).
        double: Double Q-learning.
        all_subgoals: ``False``: each level learns only about the subgoal that was pursued.
        intra_option: ``False``: levels that choose subgoals learn only from the first steps of options; where the
            sequence breaks off within an option, the value of its subgoal stands in. (With ``True``, options are
            assumed to last until their subgoal is attained or lost; a step limit of options is ignored.)
        max_meta_target, min_meta_target: largest and smallest possible return of the task, if known; the top level's
            targets are clipped to this range.
        burn_in, train_exact_states: which steps enter the loss, see :func:`~hdrqn_torchrl.objectives.training_mask`;
            in sequences that start with an episode, every state is exact.
        lookahead: number of steps at the end of each sequence that are not trained: the last one, and before it those
            that only serve the targets of earlier steps (:func:`~hdrqn_torchrl.objectives.target_lookahead`).
        loss_function: ``"l2"`` or ``"smooth_l1"`` (Huber).
        stored_state: whether sequences start, in both networks, from the LSTM state that acting had at their first
            step; from zero at the start of an episode.
        prediction_weight: weight of the error of the network's predictor, if it has one. The number of steps that it
            looks ahead is drawn again for every minibatch.

    Raises:
        ValueError: if an argument breaks its rule.

    Examples:
        >>> from torchrl.objectives import SoftUpdate
        >>> from hdrqn_torchrl.algorithms import make_v3
        >>> from hdrqn_torchrl.envs import MultiGoalGridEnv
        >>> from hdrqn_torchrl.modules import compact_network
        >>> env = MultiGoalGridEnv(num_envs=3)
        >>> agent = make_v3(env, compact_network(8, (8,)))
        >>> loss = AllSubgoalsLoss(agent.policy)
        >>> updater = SoftUpdate(loss, tau=0.01)  # of the target network: updater.step() after each gradient step
        >>> report = loss(agent.transform(env).rollout(7, agent.policy, break_when_any_done=False))
        >>> report["loss"].shape, report["priority"].shape
        (torch.Size([]), torch.Size([3]))
    """

    @dataclass
    class _AcceptedKeys:
        action: NestedKey = keys.ACTION
        hazard: NestedKey = keys.HAZARD
        extrinsic_reward: NestedKey = keys.EXTRINSIC_REWARD
        bonus: NestedKey = keys.ATTAINED
        done: NestedKey = keys.DONE
        terminated: NestedKey = keys.TERMINATED
        mask: NestedKey = keys.PAD_MASK
        priority_weight: NestedKey = "priority_weight"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys
    policy: AllSubgoalsPolicy
    policy_params: TensorDictParams
    target_policy_params: TensorDictParams
    out_keys = ["loss", "sub_loss", "td_error", "q_value", "target", "trained_steps", "priority"]

    def __init__(
        self,
        policy: AllSubgoalsPolicy,
        *,
        sub_gamma: float = 0.95,
        meta_gamma: float = 0.97,
        middle_gamma: float | None = None,
        trace_decay: float = 0.8,
        reached_reward: float = 1.0,
        wrong_subgoal_reward: float | Sequence[float] = 0.0,
        hazard_reward: float = -1.0,
        bonus_reward: float = 0.0,
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
        middle_gamma = meta_gamma if middle_gamma is None else middle_gamma
        rates = {"sub_gamma": sub_gamma, "meta_gamma": meta_gamma, "middle_gamma": middle_gamma}
        for name, value in {**rates, "trace_decay": trace_decay}.items():
            if not 0.0 <= value <= 1.0:
                raise ValueError(f"{name} must lie in [0, 1], got {value}; make_v3 has 0.9, 0.95 and 0.8.")
        check_bounds(min_meta_target, max_meta_target, names=("min_meta_target", "max_meta_target"))
        if lookahead < 1:
            raise ValueError(f"lookahead must be >= 1 step, got {lookahead}; the last step is never trained.")
        super().__init__(
            policy,
            "policy",
            burn_in=burn_in,
            train_exact_states=train_exact_states,
            lookahead=lookahead,
            double=double,
            loss_function=loss_function,
            predictor=policy.network.predictor,
            prediction_weight=prediction_weight,
        )
        self.rules = make_rules(
            policy.subgoal_keys,
            action_mask_key=policy.action_mask_key,
            **rates,
            reached_reward=reached_reward,
            wrong_subgoal_reward=wrong_subgoal_reward,
            hazard_reward=hazard_reward,
            largest_return=max_meta_target,
            smallest_return=min_meta_target,
        )
        self.targets = LevelTargets(
            rules=self.rules,
            trace_decay=trace_decay,
            double=double,
            all_subgoals=all_subgoals,
            intra_option=intra_option,
        )
        self.bonus_reward, self.reads_hazard = bonus_reward, bool(hazard_reward and policy.subgoal_keys)
        self.state_keys = list(policy.state_keys) if stored_state else []
        for rule in self.rules[1:]:
            self.out_keys = [*self.out_keys, *(f"{rule.name}_{figure}" for figure in ("loss", "td_error", "q_value"))]

    @property
    def in_keys(self) -> list[NestedKey]:
        policy, k = self._networks[0], self.tensor_keys
        read = [policy.observation_key, policy.previous_action_key, policy.init_key, *policy.mask_keys, k.action]
        read += [*self.state_keys, *(each.option_init for each in policy.subgoal_keys)]
        read += [] if policy.action_mask_key is None else [policy.action_mask_key]
        nexts = [k.extrinsic_reward, k.done, k.terminated]
        nexts += [key for each in policy.subgoal_keys for key in (each.attained, each.active_subgoal)]
        nexts += [k.hazard] if self.reads_hazard else []
        nexts += [k.bonus] if self.bonus_reward else []
        return [*read, *(unravel_key(("next", key)) for key in nexts)]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        online, target, memory = self._values(tensordict)
        valid, action = self._valid(tensordict), tensordict[self.tensor_keys.action]
        with torch.no_grad():
            columns = self.targets.columns(online, target, action, tensordict, self._events(tensordict, valid))
            wanted = self._wanted(columns)
            init = tensordict[self._networks[0].init_key].squeeze(-1)
            warm = self._warm(valid[:, :-1], init[:, :-1], self.lookahead - 1).unsqueeze(-1)
            trained = [each.trained & warm for each in columns]
        values = _chosen(online, action)
        weight = tensordict.get(self.tensor_keys.priority_weight, None)
        losses = [self._distance(*of_level, weight) for of_level in zip(values, wanted, trained, strict=True)]
        loss = torch.stack(losses).sum()
        report = self._report(losses, values, wanted, trained)
        if self._predicts:
            prediction_error = self._prediction_loss(
                memory,
                action,
                tensordict[self._networks[0].observation_key],
                valid=valid,
                cut=init[:, 1:],
            )
            loss = loss + self.prediction_weight * prediction_error
            report["prediction_loss"] = prediction_error.detach()
        return TensorDict({"loss": loss, **report}, [])

    @torch.no_grad()
    def _report(
        self, losses: list[Tensor], values: list[Tensor], wanted: list[Tensor], trained: list[Tensor]
    ) -> dict[str, Tensor]:
        """Figures of each level; those of level 0 have no prefix."""
        report = {"target": masked_mean(wanted[0], trained[0]), "trained_steps": trained[0].sum()}
        errors = [value - target for value, target in zip(values, wanted, strict=True)]
        for index, rule in enumerate(self.rules):
            prefix = f"{rule.name}_" if index else ""
            report[f"{rule.name}_loss"] = losses[index].detach()
            report[f"{prefix}td_error"] = masked_mean(errors[index].abs(), trained[index])
            report[f"{prefix}q_value"] = masked_mean(values[index], trained[index])
        report["priority"] = sequence_priority(torch.cat(errors, -1), torch.cat(trained, -1))
        return report

    def _values(self, tensordict: TensorDictBase) -> tuple[Values, Values, Tensor]:
        """Q-values of all levels ``[B, T + 1, C, X]`` by main and target network; the main network's LSTM output
        ``[B, T + 1, H]``."""
        policy = self._networks[0]
        read = (policy.observation_key, policy.previous_action_key, policy.init_key, *policy.mask_keys)
        inputs = tensordict.select(*read, *self.state_keys)

        def run(which: AllSubgoalsPolicy) -> tuple[Values, Tensor]:
            written = which(inputs.copy())
            return tuple(written.get(key) for key in which.value_keys), written.get(which.hidden_key)

        with set_recurrent_mode(True):
            with torch.no_grad():
                target, _ = run(self._networks[1])
            online, memory = run(policy)
            return online, target, memory

    def _events(self, tensordict: TensorDictBase, valid: Tensor) -> StepEvents:
        """The outcome of each step ``[B, T]``, except for subgoals."""
        k, after = self.tensor_keys, tensordict[:, :-1]["next"]
        done, terminated = after[k.done].squeeze(-1), after[k.terminated].squeeze(-1)
        last = valid[:, :-1] & ~valid[:, 1:]  # before padding
        reward = after[k.extrinsic_reward]
        if self.bonus_reward:
            reward = reward + self.bonus_reward * after[k.bonus].sum(-1, keepdim=True)
        return StepEvents(
            terminated=terminated,
            unseen=(done | last) & ~terminated,
            reward=reward,
            hazard=after[k.hazard] if self.reads_hazard else None,
        )

    def _wanted(self, columns: list[Columns]) -> list[Tensor]:
        """The targets of each level ``[B, T, C * X]``, by one recursion over the concatenated columns of all levels."""
        returns = lambda_returns(
            torch.cat([each.reward for each in columns], -1),
            torch.cat([each.ended for each in columns], -1),
            torch.cat([each.next_value for each in columns], -1),
            torch.cat([each.trace for each in columns], -1),
            torch.cat([each.discount for each in columns], -1),
        ).split([each.reward.shape[-1] for each in columns], -1)
        return [
            each.clamp(min=rule.smallest_return, max=rule.largest_return)
            for each, rule in zip(returns, self.rules, strict=True)
        ]


def _chosen(online: Values, action: Tensor) -> list[Tensor]:
    """The values that are trained: ``[B, T, C]`` of the actions taken, ``[B, T, C * X]`` of all subgoals."""
    taken = action[:, :-1, None, None].expand(*online[0][:, :-1].shape[:-1], 1)
    return [online[0][:, :-1].gather(-1, taken).squeeze(-1), *(value[:, :-1].flatten(-2) for value in online[1:])]
