"""Double Q-learning on replayed sequences (Algorithms 3 and 4)."""

from __future__ import annotations

from collections.abc import Sequence
from copy import deepcopy
from dataclasses import dataclass
from typing import Literal

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import unravel_key
from torch import Tensor
from torchrl.modules import set_recurrent_mode
from torchrl.objectives import LossModule
from torchrl.objectives.utils import distance_loss

from hdrqn_torchrl import keys
from hdrqn_torchrl.devices import on_host
from hdrqn_torchrl.modules import ObservationPredictor
from hdrqn_torchrl.objectives.prediction import prediction_loss
from hdrqn_torchrl.objectives.targets import (
    check_returns,
    double_q_value,
    greedy_choice,
    importance_weight,
    lambda_returns,
    n_step_returns,
    sequence_priority,
    smdp_target,
    training_mask,
    watkins_trace,
)


class RecurrentDQNLoss(LossModule):
    r"""Squared TD error of a recurrent Q-network on sequences ``[B, T]``, by Double Q-learning.

    .. math:: y_t = r_t + \gamma^{k_t} Q'(x_{t+1}, \arg\max_a Q(x_{t+1}, a)), \qquad
              L = \text{mean}_t\,(y_t - Q(x_t, a_t))^2

    Online and target network are each unrolled once over the T + 1 inputs :math:`x_0 \dots x_T`, from the zero
    state or from a stored one (``state_keys``), so that both see the same context. TorchRL's ``DQNLoss`` unrolls three
    times over T, starts its targets one step late and lets the state run across the slices of a flat batch, hence
    this loss.

    - Steps that enter the loss: :func:`~hdrqn_torchrl.objectives.targets.training_mask`.
    - Padding (``mask``) contributes nothing; even NaN in it reaches no gradient.
    - Where a segment ends inside a sequence without being terminated (an option's time limit), the input that
      follows belongs to the next segment; such a step is left out unless it is the last one of its sequence.
    - Longer targets (``trace_decay``, ``n_step``) go on as long as the sequence and its segment do; behind that, the
      value stands in. Steps that are left out of the loss lend nothing to others; those of the ``lookahead`` do.

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
        max_target: targets are cut off above this value: the largest return there can be, where it is known. It
            stops the overestimation that bootstrapping builds up while rewards are still rare.
        predictor: part of the value network that predicts observations from its memory; its error joins the loss.
        prediction_weight: of that error.
        trace_decay: lambda of Watkins' Q(lambda): a target takes over this share of the next step's own target, if
            the next action is the main network's greedy one. 0 is the one-step target.
        n_step: rewards before the value; 1 is the one-step target. Later actions are taken as they came, exploratory
            or not, as in Rainbow (Hessel et al., 2018) and R2D2: some bias for faster news.
        lookahead: steps at the end of each sequence that are there for the targets of those before and are not trained
            themselves (:func:`~hdrqn_torchrl.objectives.target_lookahead`); ``burn_in`` is a share of the others.
        state_keys: recurrent states that acting had, stored with the steps: sequences start from them, in both
            networks (Kapturowski et al., 2019), and from zero where ``init`` is set. None: all start from zero.
        delay_value: whether a target network is kept (update it with TorchRL's ``SoftUpdate`` or ``HardUpdate``).

    Keys (``set_keys``): ``action``, ``action_value``; ``reward``, ``done``, ``terminated`` (under ``"next"``);
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
        loss_function: Literal["l2", "smooth_l1"] = "l2",
        max_target: float | None = None,
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
        if not 0.0 <= burn_in < 1.0:
            raise ValueError(f"burn_in must lie in [0, 1), got {burn_in}; the paper's last-half rule is 0.5.")
        if loss_function not in ("l2", "smooth_l1"):
            raise ValueError(f"loss_function must be 'l2' or 'smooth_l1', got {loss_function!r}; the paper uses 'l2'.")
        check_returns(trace_decay, n_step)
        if lookahead < 0:
            raise ValueError(f"lookahead must be >= 0 steps, got {lookahead}; use target_lookahead().")
        if unknown := {unravel_key(key) for key in state_keys} - {unravel_key(key) for key in value_network.in_keys}:
            raise ValueError(
                f"state_keys must be recurrent states that the network reads, got {sorted(map(str, unknown))}; a "
                "feed-forward network has none."
            )
        super().__init__()
        self.convert_to_functional(value_network, "value_network", create_target_params=delay_value)
        # Both networks as they are called, outside the module tree: their parameters are those registered above.
        # Calling them directly saves two parameter swaps an update.
        target = value_network
        if delay_value:
            target = deepcopy(value_network)
            self._modules["target_value_network_params"].to_module(target, preserve_module_state=False)
        self.__dict__["_networks"] = (value_network, target)
        self.register_buffer("gamma", torch.tensor(gamma))
        self.burn_in, self.train_exact_states = burn_in if self._written_states else 0.0, train_exact_states
        self.lookahead = lookahead
        self.double, self.loss_function, self.max_target = double, loss_function, max_target
        self.trace_decay, self.n_step = trace_decay, n_step
        self.__dict__["_predictor"] = predictor  # its parameters are the network's
        self.prediction_weight = prediction_weight
        if predictor is not None:
            self.out_keys = [*self.out_keys, "prediction_loss"]
        self.state_keys = list(state_keys)

    def _forward_value_estimator_keys(self, **kwargs) -> None:
        """The keys are read at every call; nothing to pass on."""

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
        return [key for key in network.in_keys if unravel_key(key) not in left_out]

    @property
    def in_keys(self) -> list[NestedKey]:
        k = self.tensor_keys
        nexts = [k.reward, k.done, k.terminated, *([] if k.steps is None else [k.steps]), *self._input_keys]
        masks = [] if k.action_mask is None else [k.action_mask]
        flags = [k.init] if k.eligible is None else [k.init, k.eligible]
        now = [k.action, *flags, *self._input_keys, *self.state_keys, *masks]
        return [*now, *(unravel_key(("next", key)) for key in nexts + masks)]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        k, after = self.tensor_keys, tensordict["next"]
        init = _steps_of(tensordict[k.init], tensordict)
        mask = tensordict.get(k.mask, None)
        valid = torch.ones_like(init) if mask is None else _steps_of(mask, tensordict)
        init = init & valid
        done, terminated = _steps_of(after[k.done], tensordict), _steps_of(after[k.terminated], tensordict)

        inputs = self._inputs(tensordict, valid, init)
        online, target, memory = self._action_values(inputs)
        chosen = online[:, :-1].gather(-1, tensordict[k.action].unsqueeze(-1)).squeeze(-1)
        with torch.no_grad():
            allowed = None if k.action_mask is None else inputs.get(k.action_mask)
            chooser = online.detach() if self.double else target
            next_value = double_q_value(chooser[:, 1:], target[:, 1:], None if allowed is None else allowed[:, 1:])
            steps = None if k.steps is None else _steps_of(after[k.steps], tensordict)
            reward = _steps_of(after[k.reward], tensordict)
            usable = valid & ~_ends_unseen(done & ~terminated, valid)
            if k.eligible is not None:
                usable = usable & _steps_of(tensordict[k.eligible], tensordict)
            if self.n_step == 1 and not self.trace_decay:
                wanted = smdp_target(reward, terminated, next_value, self.gamma, steps)
            else:
                # A terminated step has no future and a cut one no target, so only the next step need be looked at.
                follows = (usable & ~init).roll(-1, 1)  # what the last step gets is not read
                best = greedy_choice(online, allowed)[:, :-1]
                wanted = self._longer_targets(
                    reward.masked_fill(~valid, 0.0),
                    terminated,
                    next_value,
                    self.gamma if steps is None else self.gamma**steps,
                    follows=follows,
                    greedy=best == tensordict[k.action],
                )
            if self.max_target is not None:
                wanted = wanted.clamp(max=self.max_target)
            trained = usable & training_mask(valid, init, self.burn_in, self.train_exact_states, self.lookahead)
            count = trained.sum().clamp(min=1)
            wanted = torch.where(trained, wanted, chosen)
        distance = distance_loss(chosen, wanted, self.loss_function).masked_fill(~trained, 0.0)
        if (weight := tensordict.get(k.priority_weight, None)) is not None:
            distance = distance * importance_weight(weight).unsqueeze(-1)
        loss = distance.sum() / count
        with torch.no_grad():
            report = {
                "td_error": (wanted - chosen).abs().masked_fill(~trained, 0.0).sum() / count,
                "q_value": chosen.detach().masked_fill(~trained, 0.0).sum() / count,
                "target": wanted.masked_fill(~trained, 0.0).sum() / count,
                "trained_steps": trained.sum(),
                "priority": sequence_priority(wanted - chosen, trained),
            }
        if self._predictor is not None and memory is not None:
            prediction_error = self._prediction_loss(memory, inputs, tensordict, valid)
            loss = loss + self.prediction_weight * prediction_error
            report["prediction_loss"] = prediction_error.detach()
        return TensorDict({"loss": loss, **report}, [])

    def _prediction_loss(
        self, memory: Tensor, inputs: TensorDictBase, tensordict: TensorDictBase, valid: Tensor
    ) -> Tensor:
        """Mean error of predictions within an episode; options may end on the way."""
        k = self.tensor_keys
        return prediction_loss(
            self._predictor,
            memory,
            tensordict[k.action],
            inputs[k.observation],
            valid=torch.cat([valid[:, :1], valid], 1),
            cut=_steps_of(tensordict["next", k.episode_done], tensordict),
        )

    def _longer_targets(
        self, reward: Tensor, ended: Tensor, next_value: Tensor, discount: Tensor, *, follows: Tensor, greedy: Tensor
    ) -> Tensor:
        """Targets ``[B, T]`` that take over the next step's own where that ``follows`` and has one to lend."""
        if self.n_step > 1:
            return n_step_returns(reward, ended, next_value, follows, discount, self.n_step)
        trace = watkins_trace(greedy, self.trace_decay).masked_fill(~follows, 0.0)
        return lambda_returns(reward, ended, next_value, trace, discount)

    def _inputs(self, tensordict: TensorDictBase, valid: Tensor, init: Tensor) -> TensorDictBase:
        """The T + 1 inputs of each sequence: what was seen at each step, then what followed the last valid one."""
        k = self.tensor_keys
        mask_keys = [] if k.action_mask is None else [k.action_mask]
        padded = k.mask in tensordict.keys(True) and not (on_host(valid) and bool(valid.all()))
        nothing = torch.zeros_like(valid[:, :1])
        own, reached = torch.cat([valid, nothing], 1), torch.cat([nothing, valid], 1)  # seen at, or after, a valid step
        inputs = TensorDict({}, (tensordict.shape[0], tensordict.shape[1] + 1), device=tensordict.device)
        for key in (*self._input_keys, *mask_keys):
            now, following = tensordict[key], tensordict[unravel_key(("next", key))]
            stream = torch.cat([now, following[:, -1:]], 1)
            if padded:
                stream = torch.where(_expand(own, stream), stream, torch.cat([now[:, :1], following], 1))
                if stream.is_floating_point():
                    stream = stream.masked_fill(~_expand(own | reached, stream), 0.0)
            inputs.set(key, stream)
        for key in self.state_keys:
            state = tensordict[key]
            state = state.masked_fill(_expand(init | ~valid, state), 0.0)
            inputs.set(key, torch.cat([state, torch.zeros_like(state[:, :1])], 1))
        restart = torch.cat([init, torch.zeros_like(init[:, :1])], 1)
        return inputs.set(k.init, restart.unsqueeze(-1))

    def _action_values(self, inputs: TensorDictBase) -> tuple[Tensor, Tensor, Tensor | None]:
        """Q-values ``[B, T + 1, A]`` of main and target network; if it predicts, the main one's memory."""
        network, target_network = self._networks
        key = self.tensor_keys.action_value
        with set_recurrent_mode(True):
            with torch.no_grad():
                target = target_network(inputs.copy()).get(key)
            online = network(inputs.copy())
        return online.get(key), target, online.get(self.tensor_keys.memory, None)


def _steps_of(value: Tensor, tensordict: TensorDictBase) -> Tensor:
    """Drops the trailing dimension of a per-step scalar."""
    return value if value.ndim == tensordict.ndim else value.squeeze(-1)


def _expand(mask: Tensor, like: Tensor) -> Tensor:
    return mask.view(mask.shape + (1,) * (like.ndim - mask.ndim))


def _ends_unseen(cut: Tensor, valid: Tensor) -> Tensor:
    """Steps that are cut off (``cut``) although another valid step follows: what they led to is not in the sequence."""
    followed = torch.cat([valid[:, 1:], torch.zeros_like(valid[:, :1])], 1)
    return cut & followed
