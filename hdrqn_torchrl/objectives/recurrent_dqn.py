"""Double Q-learning on replayed sequences (Algorithms 3 and 4)."""

from __future__ import annotations

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
from hdrqn_torchrl.objectives.targets import double_q_value, smdp_target, training_mask


class RecurrentDQNLoss(LossModule):
    r"""Squared TD error of a recurrent Q-network on sequences ``[B, T]``, by Double Q-learning.

    .. math:: y_t = r_t + \gamma^{k_t} Q'(x_{t+1}, \arg\max_a Q(x_{t+1}, a)), \qquad
              L = \text{mean}_t\,(y_t - Q(x_t, a_t))^2

    Online and target network are each unrolled once over the T + 1 inputs :math:`x_0 \dots x_T`, from the zero
    state, so that both see the same context. TorchRL's ``DQNLoss`` unrolls three times over T, starts its targets
    one step late and lets the state run across the slices of a flat batch, hence this loss.

    - Steps that enter the loss: :func:`~hdrqn_torchrl.objectives.targets.training_mask`.
    - Padding (``mask``) contributes nothing; even NaN in it reaches no gradient.
    - Where a segment ends inside a sequence without being terminated (an option's time limit), the input that
      follows belongs to the next segment; such a step is left out unless it is the last one of its sequence.

    Args:
        value_network: in recurrent mode reads its ``in_keys`` ``[B, T + 1, ...]`` and writes ``action_value``
            ``[B, T + 1, A]``: one of our controllers, or any TorchRL sequence of modules with an ``LSTMModule``.
            Entries that it also writes to ``"next"`` are recurrent states and start from zero.

    Keyword Args:
        gamma: discount of one environment step.
        burn_in: share of each sequence left out of the loss at its beginning; the paper's last-half rule is 0.5.
        train_exact_states: train leading steps, too, whose recurrent state is exact.
        double: choose the next action by the main network (Double DQN) instead of the target network.
        loss_function: ``"l2"`` or ``"smooth_l1"`` (Huber).
        max_target: targets are cut off above this value: the largest return there can be, where it is known. It
            stops the overestimation that bootstrapping builds up while rewards are still rare.
        delay_value: whether a target network is kept (update it with TorchRL's ``SoftUpdate`` or ``HardUpdate``).

    Keys (``set_keys``): ``action``, ``action_value``; ``reward``, ``done``, ``terminated`` (under ``"next"``);
    ``steps`` (under ``"next"``, ``None``: 1); ``init`` (restart of the state); ``mask`` (padding);
    ``action_mask`` (choices that exist, ``None``: all).

    Returns (``forward``): ``loss`` (scalar), and without gradient ``td_error`` (mean absolute), ``q_value`` and
    ``target`` (means), ``trained_steps`` (how many steps entered the loss).

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
        action_mask: NestedKey | None = None

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys
    value_network: TensorDictModuleBase
    value_network_params: TensorDictParams
    target_value_network: TensorDictModuleBase
    target_value_network_params: TensorDictParams
    gamma: Tensor
    out_keys = ["loss", "td_error", "q_value", "target", "trained_steps"]

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
        delay_value: bool = True,
    ) -> None:
        if not 0.0 <= gamma <= 1.0:
            raise ValueError(f"gamma must lie in [0, 1], got {gamma}; the paper uses 0.99.")
        if not 0.0 <= burn_in < 1.0:
            raise ValueError(f"burn_in must lie in [0, 1), got {burn_in}; the paper's last-half rule is 0.5.")
        if loss_function not in ("l2", "smooth_l1"):
            raise ValueError(f"loss_function must be 'l2' or 'smooth_l1', got {loss_function!r}; the paper uses 'l2'.")
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
        self.burn_in, self.train_exact_states = burn_in, train_exact_states
        self.double, self.loss_function, self.max_target = double, loss_function, max_target

    def _forward_value_estimator_keys(self, **kwargs) -> None:
        """The keys are read at every call; nothing to pass on."""

    @property
    def _input_keys(self) -> list[NestedKey]:
        """What the network reads, without its recurrent states, the restart flag and the action mask."""
        network = self._networks[0]
        states = [key[1:] for key in network.out_keys if isinstance(key, tuple) and key[0] == "next"]
        left_out = {unravel_key(key) for key in states} | {self.tensor_keys.init, self.tensor_keys.action_mask}
        return [key for key in network.in_keys if unravel_key(key) not in left_out]

    @property
    def in_keys(self) -> list[NestedKey]:
        k = self.tensor_keys
        nexts = [k.reward, k.done, k.terminated, *([] if k.steps is None else [k.steps]), *self._input_keys]
        masks = [] if k.action_mask is None else [k.action_mask]
        return [k.action, k.init, *self._input_keys, *masks, *(unravel_key(("next", key)) for key in nexts + masks)]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        k, after = self.tensor_keys, tensordict["next"]
        init = _steps_of(tensordict[k.init], tensordict)
        mask = tensordict.get(k.mask, None)
        valid = torch.ones_like(init) if mask is None else _steps_of(mask, tensordict)
        init = init & valid
        done, terminated = _steps_of(after[k.done], tensordict), _steps_of(after[k.terminated], tensordict)

        inputs = self._inputs(tensordict, valid, init)
        online, target = self._action_values(inputs)
        chosen = online[:, :-1].gather(-1, tensordict[k.action].unsqueeze(-1)).squeeze(-1)
        with torch.no_grad():
            allowed = None if k.action_mask is None else inputs.get(k.action_mask)[:, 1:]
            chooser = online.detach() if self.double else target
            next_value = double_q_value(chooser[:, 1:], target[:, 1:], allowed)
            steps = None if k.steps is None else _steps_of(after[k.steps], tensordict)
            reward = _steps_of(after[k.reward], tensordict)
            wanted = smdp_target(reward, terminated, next_value, self.gamma, steps)
            if self.max_target is not None:
                wanted = wanted.clamp(max=self.max_target)
            trained = training_mask(valid, init, self.burn_in, self.train_exact_states)
            trained = trained & ~_ends_unseen(done & ~terminated, valid)
            count = trained.sum().clamp(min=1)
            wanted = torch.where(trained, wanted, chosen)
        loss = distance_loss(chosen, wanted, self.loss_function).masked_fill(~trained, 0.0).sum() / count
        with torch.no_grad():
            report = {
                "td_error": (wanted - chosen).abs().masked_fill(~trained, 0.0).sum() / count,
                "q_value": chosen.detach().masked_fill(~trained, 0.0).sum() / count,
                "target": wanted.masked_fill(~trained, 0.0).sum() / count,
                "trained_steps": trained.sum(),
            }
        return TensorDict({"loss": loss, **report}, [])

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
        restart = torch.cat([init, torch.zeros_like(init[:, :1])], 1)
        return inputs.set(k.init, restart.unsqueeze(-1))

    def _action_values(self, inputs: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Q-values ``[B, T + 1, A]`` of main and target network."""
        network, target_network = self._networks
        key = self.tensor_keys.action_value
        with set_recurrent_mode(True):
            with torch.no_grad():
                target = target_network(inputs.copy()).get(key)
            return network(inputs.copy()).get(key), target


def _steps_of(value: Tensor, tensordict: TensorDictBase) -> Tensor:
    """Drops the trailing dimension of a per-step scalar."""
    return value if value.ndim == tensordict.ndim else value.squeeze(-1)


def _expand(mask: Tensor, like: Tensor) -> Tensor:
    return mask.view(mask.shape + (1,) * (like.ndim - mask.ndim))


def _ends_unseen(cut: Tensor, valid: Tensor) -> Tensor:
    """Steps that are cut off (``cut``) although another valid step follows: what they led to is not in the sequence."""
    followed = torch.cat([valid[:, 1:], torch.zeros_like(valid[:, :1])], 1)
    return cut & followed
