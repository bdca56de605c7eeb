"""Double Q-learning on replayed sequences (Algorithms 3 and 4)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import unravel_key
from torch import Tensor
from torchrl.modules import set_recurrent_mode

from hdrqn_torchrl import keys
from hdrqn_torchrl.modules import ObservationPredictor
from hdrqn_torchrl.objectives.base import LossFunction, SequenceLoss, masked_mean
from hdrqn_torchrl.objectives.sequences import Sequences, step_of, take_apart
from hdrqn_torchrl.objectives.targets import (
    check_bounds,
    check_returns,
    greedy_choice,
    lambda_returns,
    n_step_returns,
    sequence_priority,
    smdp_target,
    watkins_trace,
)


class RecurrentDQNLoss(SequenceLoss):
    r"""Squared TD error of a recurrent Q-network on sequences, by Double Q-learning.

    .. math:: y_t = r_t + \gamma^{k_t} Q'(x_{t+1}, \arg\max_a Q(x_{t+1}, a)), \qquad
              L = \text{mean}_t\,(y_t - Q(x_t, a_t))^2

    Online and target network are each unrolled once over the T + 1 inputs :math:`x_0 \ldots x_T`, from the zero
    state or from a stored one (``state_keys``), so that both see the same context. TorchRL's ``DQNLoss`` unrolls three
    times over T, starts its targets one step late and lets the state run across the slices of a flat batch, hence
    this loss.

    Sequences come in two forms:

    - with ``lookahead`` >= 1, each input is stored once: the last of the T + 1 steps only shows what the one before
      led to. So does, for options, the row that ends a truncated episode
      (:class:`~hdrqn_torchrl.data.OptionExtractor`);
    - standard TorchRL sequences of T steps hold each input twice, at the root and under ``"next"``; of the latter the
      last one is read.

    Steps that enter the loss: :func:`~hdrqn_torchrl.objectives.training_mask`, and of these all whose target is in the
    sequence. That of a terminated step always is. Otherwise it is not if the step is the last real one, if an episode
    is truncated there, or if an option ends there without being terminated (its time limit; a subgoal that could not
    be chosen to begin with): the next step then pursues another subgoal, with a fresh memory, and says nothing about
    the value of going on. In the second form the target of the last step is there in any case.

    Padding (``mask``) contributes nothing; even NaN in it reaches no gradient. Longer targets (``trace_decay``,
    ``n_step``) go on as long as the sequence and its segment do; behind that, the value stands in. Steps that are left
    out of the loss lend nothing to others; those of the ``lookahead`` do.

    Args:
        value_network: in recurrent mode reads its ``in_keys`` ``[B, T + 1, ...]`` and writes ``action_value``
            ``[B, T + 1, A]``: one of our controllers, or any TorchRL sequence of modules with an ``LSTMModule``.
            Entries that it also writes to ``"next"`` are recurrent states and start from zero, or from ``state_keys``.

    Keyword Args:
        gamma: discount of one environment step.
        burn_in: share of each sequence left out of the loss at its beginning; the paper's last-half rule is 0.5. A
            network without memory has no state to bring up to date: there it is 0.
        train_exact_states: train leading steps, too, whose recurrent state is exact.
        double: choose the next action by the main network (Double DQN) instead of the target network.
        loss_function: ``"l2"`` or ``"smooth_l1"`` (Huber).
        max_target, min_target: bounds of the targets: the largest and the smallest return there can be, where they are
            known. They stop the errors that bootstrapping builds up: overestimation while rewards are still rare, and
            values far below anything possible where episodes are cut off.
        predictor: part of the value network that predicts observations from its memory; its error joins the loss.
        prediction_weight: of that error.
        trace_decay: lambda of Watkins' Q(lambda): a target takes over this share of the next step's own target, if
            the next action is the main network's greedy one. 0 is the one-step target.
        n_step: rewards before the value; 1 is the one-step target. Later actions are taken as they came, exploratory
            or not, as in Rainbow (Hessel et al., 2018) and R2D2: some bias for faster news.
        lookahead: steps at the end of each sequence that are there for the targets of those before and are not trained
            themselves; ``burn_in`` is a share of the others. Inputs that are stored once need 1, longer targets
            :func:`~hdrqn_torchrl.objectives.target_lookahead` more.
        state_keys: recurrent states that acting had, stored with the steps: sequences start from them, in both
            networks (Kapturowski et al., 2019), and from zero where ``init`` is set. None: all start from zero.
        delay_value: whether a target network is kept (update it with TorchRL's ``SoftUpdate`` or ``HardUpdate``).

    Keys (``set_keys``; those that a network states in ``loss_keys``, as our controllers do, are the defaults):
    ``action``, ``action_value``; ``reward``, ``done``, ``terminated`` (under ``"next"``);
    ``steps`` (under ``"next"``, ``None``: 1); ``init`` (restart of the state); ``mask`` (padding);
    ``action_mask`` (choices that exist, ``None``: all); ``eligible`` (steps that may enter the loss, ``None``: all;
    unlike padding they are read, and may lie anywhere); ``priority_weight`` (of sequences drawn by priority);
    for a predictor ``observation``, ``memory`` (what the network writes) and ``episode_done`` (under ``"next"``).

    Returns (``forward``): ``loss`` (scalar), and without gradient ``td_error`` (mean absolute), ``q_value`` and
    ``target`` (means), ``trained_steps`` (how many steps entered the loss), ``priority`` (of each
    sequence, ``[B]``; see :func:`~hdrqn_torchrl.objectives.sequence_priority`).

    Examples:
        >>> from hdrqn_torchrl.modules import CellFeatures, QNetwork, SubController
        >>> network = QNetwork(CellFeatures(5, num_codes=5), num_actions=4, hidden_size=8)
        >>> loss = RecurrentDQNLoss(SubController(network, subgoal_key=None, init_key="is_init"))
        >>> td = TensorDict(batch_size=[2, 6])
        >>> td["observation"] = td["next", "observation"] = torch.zeros(2, 6, 5, 5, dtype=torch.uint8)
        >>> td["action"], td["next", "reward"] = torch.zeros(2, 6, dtype=torch.int64), torch.ones(2, 6, 1)
        >>> td["is_init"] = td["next", "done"] = td["next", "terminated"] = torch.zeros(2, 6, 1, dtype=torch.bool)
        >>> int(loss(td)["trained_steps"])
        6
    """

    @dataclass
    class _AcceptedKeys:
        action: NestedKey = keys.ACTION
        action_value: NestedKey = keys.ACTION_VALUE
        reward: NestedKey = keys.REWARD
        done: NestedKey = keys.DONE
        terminated: NestedKey = keys.TERMINATED
        steps: NestedKey | None = None
        init: NestedKey = keys.IS_INIT
        mask: NestedKey = keys.PAD_MASK
        priority_weight: NestedKey = "priority_weight"
        action_mask: NestedKey | None = None
        observation: NestedKey = keys.OBSERVATION
        memory: NestedKey = keys.SUB_HIDDEN
        episode_done: NestedKey = keys.DONE
        eligible: NestedKey | None = None

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys
    value_network: TensorDictModuleBase
    value_network_params: TensorDictParams
    target_value_network: TensorDictModuleBase
    target_value_network_params: TensorDictParams
    gamma: Tensor
    out_keys = ["loss", "td_error", "q_value", "target", "trained_steps", "priority"]

    def __init__(
        self,
        value_network: TensorDictModuleBase,
        *,
        gamma: float = 0.99,
        burn_in: float = 0.5,
        train_exact_states: bool = True,
        double: bool = True,
        loss_function: LossFunction = "l2",
        max_target: float | None = None,
        min_target: float | None = None,
        predictor: ObservationPredictor | None = None,
        prediction_weight: float = 0.1,
        trace_decay: float = 0.0,
        n_step: int = 1,
        lookahead: int = 0,
        state_keys: Sequence[NestedKey] = (),
        delay_value: bool = True,
    ) -> None:
        if not 0.0 <= gamma <= 1.0:
            raise ValueError(f"gamma must lie in [0, 1], got {gamma}; the paper uses 0.99.")
        check_returns(trace_decay, n_step)
        check_bounds(min_target, max_target, names=("min_target", "max_target"))
        if unknown := {unravel_key(key) for key in state_keys} - {unravel_key(key) for key in _read_by(value_network)}:
            raise ValueError(
                f"state_keys must be recurrent states that the network reads, got {sorted(map(str, unknown))}; a "
                "feed-forward network has none."
            )
        super().__init__(
            value_network,
            "value_network",
            burn_in=burn_in,
            train_exact_states=train_exact_states,
            lookahead=lookahead,
            double=double,
            loss_function=loss_function,
            predictor=predictor,
            prediction_weight=prediction_weight,
            delay_value=delay_value,
        )
        self.register_buffer("gamma", torch.tensor(gamma))
        if not self._written_states:
            self.burn_in = 0.0
        self.min_target, self.max_target = min_target, max_target
        self.trace_decay, self.n_step = trace_decay, n_step
        self.state_keys = list(state_keys)
        self.set_keys(**getattr(value_network, "loss_keys", {}))

    @property
    def _written_states(self) -> set[NestedKey]:
        """The network's recurrent states; a network without memory has none."""
        out_keys = self._networks[0].out_keys
        return {unravel_key(key[1:]) for key in out_keys if isinstance(key, tuple) and key[0] == "next"}

    @property
    def _input_keys(self) -> list[NestedKey]:
        """What the network reads, without its recurrent states, the restart flag and the action mask."""
        network = self._networks[0]
        left_out = self._written_states | {self.tensor_keys.init, self.tensor_keys.action_mask}
        return [key for key in _read_by(network) if unravel_key(key) not in left_out]

    @property
    def in_keys(self) -> list[NestedKey]:
        k, read = self.tensor_keys, self._read_keys
        now = [k.action, k.init, *read, *self.state_keys, *([] if k.eligible is None else [k.eligible])]
        nexts = [k.reward, k.done, k.terminated, *([] if k.steps is None else [k.steps])]
        return [*now, *(unravel_key(("next", key)) for key in nexts + ([] if self.lookahead else read))]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        k, parts = self.tensor_keys, self._take_apart(tensordict)
        steps, after = parts.steps, parts.steps["next"]
        online, target, memory = self._action_values(parts.inputs)
        chosen = online[:, :-1].gather(-1, steps[k.action].unsqueeze(-1)).squeeze(-1)
        with torch.no_grad():
            usable = parts.valid & (step_of(after[k.terminated], steps) | ~parts.cut)
            if k.eligible is not None:
                usable = usable & step_of(steps[k.eligible], steps)
            wanted = self._targets(online.detach(), target, parts, usable)
            trained = usable & self._warm(parts.valid, parts.init, parts.lookahead)
        loss = self._distance(chosen, wanted, trained, tensordict.get(k.priority_weight, None))
        with torch.no_grad():
            error = wanted - chosen
            report = {
                "td_error": masked_mean(error.abs(), trained),
                "q_value": masked_mean(chosen, trained),
                "target": masked_mean(wanted, trained),
                "trained_steps": trained.sum(),
                "priority": sequence_priority(error, trained),
            }
        if self._predicts and memory is not None:
            ends, seen = step_of(after[k.episode_done], steps), parts.seen
            observation = parts.inputs[k.observation]
            error = self._prediction_loss(memory, steps[k.action], observation, valid=seen, cut=ends)
            loss = loss + self.prediction_weight * error
            report["prediction_loss"] = error.detach()
        return TensorDict({"loss": loss, **report}, [])

    def _targets(self, online: Tensor, target: Tensor, parts: Sequences, usable: Tensor) -> Tensor:
        """Targets ``[B, T]`` by Q-values ``[B, T + 1, A]``; those of steps that are not ``usable`` mean nothing."""
        k, after = self.tensor_keys, parts.steps["next"]
        allowed = None if k.action_mask is None else parts.inputs.get(k.action_mask)
        following = self._double_value(online[:, 1:], target[:, 1:], None if allowed is None else allowed[:, 1:])
        reward, terminated = (step_of(after[key], parts.steps) for key in (k.reward, k.terminated))
        lasted = None if k.steps is None else step_of(after[k.steps], parts.steps)
        if self.n_step == 1 and not self.trace_decay:
            wanted = smdp_target(reward, terminated, following, self.gamma, lasted)
        else:
            best = greedy_choice(online, allowed)[:, :-1]
            wanted = self._longer_targets(
                reward.masked_fill(~parts.valid, 0.0),
                terminated,
                following,
                self.gamma if lasted is None else self.gamma**lasted,
                # A terminated step has no future and a cut one no target, so only the next step need be looked at.
                follows=(usable & ~parts.init).roll(-1, 1),  # what the last step gets is not read
                greedy=best == parts.steps[k.action],
            )
        if self.min_target is None and self.max_target is None:
            return wanted
        return wanted.clamp(min=self.min_target, max=self.max_target)

    def _longer_targets(
        self, reward: Tensor, ended: Tensor, next_value: Tensor, discount: Tensor, *, follows: Tensor, greedy: Tensor
    ) -> Tensor:
        """Targets ``[B, T]`` that take over the next step's own where that ``follows`` and has one to lend."""
        if self.n_step > 1:
            return n_step_returns(reward, ended, next_value, follows, discount, self.n_step)
        trace = watkins_trace(greedy, self.trace_decay).masked_fill(~follows, 0.0)
        return lambda_returns(reward, ended, next_value, trace, discount)

    def _take_apart(self, tensordict: TensorDictBase) -> Sequences:
        """Inputs and steps of sequences of either form."""
        k, reads_next = self.tensor_keys, tensordict.get(("next", self._input_keys[0]), None) is not None
        return take_apart(
            tensordict,
            self._valid(tensordict),
            read_keys=self._read_keys,
            state_keys=self.state_keys,
            init_key=k.init,
            done_key=k.done,
            lookahead=self.lookahead,
            stored_once=self.lookahead > 0 and not reads_next,
        )

    @property
    def _read_keys(self) -> list[NestedKey]:
        mask_key = self.tensor_keys.action_mask
        return [*self._input_keys, *([] if mask_key is None else [mask_key])]

    def _action_values(self, inputs: TensorDictBase) -> tuple[Tensor, Tensor, Tensor | None]:
        """Q-values ``[B, T + 1, A]`` of main and target network; if it predicts, the main one's memory."""
        network, target_network = self._networks
        key = self.tensor_keys.action_value
        with set_recurrent_mode(True):
            with torch.no_grad():
                target = target_network(inputs.copy()).get(key)
            online = network(inputs)
        return online.get(key), target, online.get(self.tensor_keys.memory, None)


def _read_by(network: TensorDictModuleBase) -> list[NestedKey]:
    """What a network reads of sequences; ours may read more in acting."""
    return getattr(network, "learning_keys", network.in_keys)
