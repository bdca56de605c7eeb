"""Adam over the parts of a network, each with a share of the learning rate."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor
from torch.nn import Parameter


class GroupedAdam(torch.optim.Adam):
    """Fused Adam. Parts that are optimised separately also have gradients clipped by their own norm.

    Args:
        parameters: by name.
        separate: prefixes of the names of such parts, and their shares of the learning rate.
        learning_rate: of all the rest.
        capturable: whether steps can be captured: learning rates are then tensors next to the parameters.

    Raises:
        ValueError: if a part has no parameters, or a share is not positive.

    Examples:
        >>> network = torch.nn.ModuleDict({"body": torch.nn.Linear(2, 2), "head": torch.nn.Linear(2, 1)})
        >>> adam = GroupedAdam(dict(network.named_parameters()), separate={"head": 0.5}, learning_rate=0.1)
        >>> [group["lr"] for group in adam.param_groups]
        [0.1, 0.05]
    """

    def __init__(
        self,
        parameters: Mapping[str, Parameter],
        *,
        separate: Mapping[str, float],
        learning_rate: float,
        capturable: bool = False,
    ) -> None:
        groups = _group(parameters, separate)
        self.shares = [share for share, _ in groups]
        members = [{"params": members} for _, members in groups]
        super().__init__(members, lr=learning_rate, fused=True, capturable=capturable)
        self._rates = [torch.tensor(learning_rate, device=members[0].device) for _, members in groups]
        self._capturable = capturable
        self.set_learning_rate(learning_rate)

    def __getstate__(self) -> dict[str, Any]:
        """For copies: Adam's own is of groups and moments only."""
        return super().__getstate__() | {name: getattr(self, name) for name in ("shares", "_rates", "_capturable")}

    def set_learning_rate(self, rate: float) -> None:
        """Sets the rate of every part."""
        for share, group, own in zip(self.shares, self.param_groups, self._rates, strict=True):
            group["lr"] = own.fill_(share * rate) if self._capturable else share * rate

    def state_dict(self) -> dict[str, Any]:
        """What torch's Adam returns, with learning rates as numbers: the same, whether steps can be captured or not."""
        state = super().state_dict()
        for group in state["param_groups"]:
            group.update(lr=float(group["lr"]), capturable=False)
        return state

    def clip_gradients(self, largest: float, norm: Tensor) -> None:
        """Clips the gradients of each part to the norm ``largest``; ``norm`` is that of all parts together."""
        groups = [group["params"] for group in self.param_groups]
        for members in groups:
            if len(groups) > 1:
                norm = torch.nn.utils.get_total_norm([each.grad for each in members if each.grad is not None])
            torch.nn.utils.clip_grads_with_norm_(members, largest, norm)

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restores what ``state_dict`` returned.

        Raises:
            ValueError: if it is of other parameters or options.
        """
        if not (self._has_same_options(state_dict["param_groups"]) and self._has_same_shapes(state_dict["state"])):
            raise ValueError(
                "the stored optimiser must have the parameters, shapes and options of this one, got others; load it "
                "with the settings that it was saved with."
            )
        super().load_state_dict(state_dict)
        for group in self.param_groups:
            group["capturable"] = self._capturable
        if self._capturable:
            self.set_learning_rate(self.param_groups[0]["lr"])
        self._lay_out_like_parameters()

    def _has_same_options(self, stored: list[dict[str, Any]]) -> bool:
        own = self.state_dict()["param_groups"]
        return all(
            theirs[key] == mine[key]
            for mine, theirs in zip(own, stored, strict=True)
            for key in mine.keys() & theirs.keys() - {"lr"}
        )

    def _has_same_shapes(self, stored: Mapping[int, Mapping[str, Tensor]]) -> bool:
        """Whether moments fit their parameters, which Adam itself would not notice."""
        parameters = [each for group in self.param_groups for each in group["params"]]
        return all(
            0 <= index < len(parameters)
            and {"step", "exp_avg", "exp_avg_sq"} <= moments.keys()
            and all(_fits(name, moment, parameters[index]) for name, moment in moments.items())
            for index, moments in stored.items()
        )

    def _lay_out_like_parameters(self) -> None:
        """Gives loaded moments the strides of their parameters: fused Adam goes through the memory of both in step.

        Files hold contiguous tensors, and convolutions have their channels last.
        """
        for parameter, state in self.state.items():
            for name, value in state.items():
                if isinstance(value, Tensor) and value.shape == parameter.shape:
                    state[name] = torch.empty_like(parameter).copy_(value)


def _fits(name: str, moment: Tensor, parameter: Parameter) -> bool:
    shapes = (torch.Size(), parameter.shape) if name == "step" else (parameter.shape,)
    return moment.dtype == parameter.dtype and moment.shape in shapes


def _group(parameters: Mapping[str, Parameter], separate: Mapping[str, float]) -> list[tuple[float, list[Parameter]]]:
    """Shares of the learning rate and whose they are: all that is not separate first."""
    groups: dict[str, tuple[float, list[Parameter]]] = {name: (share, []) for name, share in separate.items()}
    rest: list[Parameter] = []
    for name, parameter in parameters.items():
        part = next((each for each in separate if name.startswith(each)), None)
        (rest if part is None else groups[part][1]).append(parameter)
    for name, (share, members) in groups.items():
        if not members or share <= 0:
            raise ValueError(
                f"separate must map prefixes of parameters' names to shares > 0 of the learning rate, got "
                f"{name!r}: {share}, which {len(members)} parameters have; look at network.named_parameters()."
            )
    return [(1.0, rest), *groups.values()]
