"""One level of the agent as a learner: its replay memory, loss, optimiser and target network (Algorithms 3 and 4)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.objectives import HardUpdate, LossModule

from hdrqn_torchrl.data import Continuity, SequenceBuffer
from hdrqn_torchrl.devices import to_device
from hdrqn_torchrl.learning.captured import Captured, wants_capture
from hdrqn_torchrl.learning.finite import FiniteGuard
from hdrqn_torchrl.learning.loss_settings import check_loss
from hdrqn_torchrl.learning.optimizer import GroupedAdam
from hdrqn_torchrl.learning.precision import choose_precision
from hdrqn_torchrl.learning.replay import Extract, Replay, warn_old_memory
from hdrqn_torchrl.learning.settings import LearnerSettings
from hdrqn_torchrl.learning.stored import holds_inputs_twice
from hdrqn_torchrl.learning.target_network import SoftTargetUpdate
from hdrqn_torchrl.learning.update_schedule import UpdateSchedule
from hdrqn_torchrl.learning.update_step import UpdateStep


class Learner:
    """Stores what was collected, samples sequences, and updates one network from them.

    Args:
        network: the controller that is trained; the policy acts with the same parameters.
        settings: how it learns.
        extract: turns a collected batch ``[N, T]`` into what is stored, ``None`` if there is nothing yet; with
            ``state_dict`` and ``load_state_dict``.
        loss: reads a minibatch ``[batch_size, slice_len + lookahead]``, with the steps of its attribute ``lookahead``
            that it does not train (none if it has no such attribute); writes ``"loss"``, which is minimised, and
            scalars to report.
        num_envs: N if ``extract`` returns steps ``[N, T]``; ``None`` if rows ``[M]``.
        episode_len: largest number of transitions of an episode, if known (see
            :func:`~hdrqn_torchrl.data.make_sequence_buffer`).
        refresh: applied to every minibatch before it is learned from.
        refresh_reads: whether the host reads values in ``refresh``, so that it can't be captured.
        separate: parts of the network, by prefixes of their parameters' names, that are optimised separately: with
            this share of the learning rate, and with gradients clipped by their own norm.
        samples_per_draw: minibatches drawn at once, independently: one large draw costs little more than a small one.
            Priorities are those of the draw: up to ``samples_per_draw - 1`` updates old. A captured draw is of one
            minibatch, by the priorities of that moment.

    Examples:
        >>> from torchrl.collectors import Collector
        >>> from torchrl.envs import Compose, InitTracker, TransformedEnv
        >>> from hdrqn_torchrl.data import StepSelector
        >>> from hdrqn_torchrl.envs import MultiGoalGridEnv
        >>> from hdrqn_torchrl.modules import CellFeatures, QNetwork, SubController
        >>> from hdrqn_torchrl.objectives import RecurrentDQNLoss
        >>> network = QNetwork(CellFeatures(5, num_codes=5), num_actions=4, hidden_size=8)
        >>> policy = SubController(network, subgoal_key=None, init_key="is_init")
        >>> learner = Learner(
        ...     policy,
        ...     LearnerSettings(slice_len=4, batch_size=8, capacity=1_000, warmup_frames=0),
        ...     extract=StepSelector(root_keys=["observation", "action", "is_init"], next_keys=["reward"]),
        ...     loss=RecurrentDQNLoss(policy, lookahead=1),
        ...     num_envs=2,
        ... )
        >>> env = TransformedEnv(MultiGoalGridEnv(num_envs=2), Compose(InitTracker(), policy.make_tensordict_primer()))
        >>> sizes = {"frames_per_batch": 32, "total_frames": 32}
        >>> for batch in Collector(env, policy, **sizes, auto_register_policy_transforms=False):
        ...     learner.store(batch)
        >>> for _ in range(learner.updates_due()):
        ...     report = learner.learn()
        >>> learner.frames, learner.updates, report["loss"].shape
        (32, 4, torch.Size([]))
    """

    def __init__(
        self,
        network: TensorDictModuleBase,
        settings: LearnerSettings,
        *,
        extract: Extract,
        loss: LossModule,
        num_envs: int | None = None,
        episode_len: int | None = None,
        refresh: Callable[[TensorDictBase], TensorDictBase] | None = None,
        refresh_reads: bool = True,
        separate: Mapping[str, float] | None = None,
        samples_per_draw: int = 8,
    ) -> None:
        settings = settings.scaled()
        self.network, self.settings, self.loss, self.extract = network, settings, loss, extract
        if settings.priority_exponent is not None and "priority" not in loss.out_keys:
            raise ValueError(f"priority_exponent must be None for {type(loss).__name__}, which reports no priority.")
        check_loss(settings, loss, network)
        self.target_updater = SoftTargetUpdate(self.loss, tau=settings.tau)
        self._parameters = dict(network.named_parameters())
        self.device = next(iter(self._parameters.values())).device
        self.precision = choose_precision(settings.precision, network)
        self.guard = FiniteGuard(at_once=self.device.type == "cpu")
        self.schedule = UpdateSchedule(settings.warmup_frames, settings.frames_per_update)
        captures = wants_capture(settings.capture, self.device.type)
        self.optimizer = GroupedAdam(
            self._parameters, separate=separate or {}, learning_rate=self.learning_rate, capturable=captures
        )
        self.replay = Replay(
            settings,
            loss,
            num_envs=num_envs,
            episode_len=episode_len,
            samples_per_draw=samples_per_draw,
            refresh=refresh,
            on_device=captures and not (refresh is not None and refresh_reads),
            device=self.device,
        )
        self._step = UpdateStep(
            loss,
            self._parameters,
            optimizer=self.optimizer,
            target_updater=self.target_updater,
            guard=self.guard,
            max_grad_norm=settings.max_grad_norm,
        )
        self._captured = Captured(self._gradient_step) if captures else None
        first_sequence = (num_envs or 0) * self.replay.sequence_len if settings.sampling == "episode_starts" else 0
        self.first_update_at = max(settings.warmup_frames, first_sequence)
        """Frames without updates at the beginning: all worlds play the first sequence at the same time."""
        self._continuity = Continuity(memory_key=_memory_of(network))
        self.held = False
        """Whether it only stores; updates missed meanwhile are not made up for."""

    @property
    def buffer(self) -> SequenceBuffer:
        """Its replay memory."""
        return self.replay.buffer

    @property
    def frames(self) -> int:
        """Environment steps seen so far."""
        return self.schedule.frames

    @property
    def updates(self) -> int:
        """Updates made so far."""
        return self.schedule.updates

    @property
    def learning_rate(self) -> float:
        """Adam's rate at the frames seen so far."""
        return self.settings.rate_at(self.frames)

    def store(self, batch: TensorDictBase) -> None:
        """Puts into the replay memory what this level learns from in ``batch`` ``[N, T]``.

        Raises:
            ValueError: if the batch is not of the environments that the memory was built for, or does not go on where
                the last one ended (:class:`~hdrqn_torchrl.data.Continuity`).
            NonFiniteError: as :meth:`check_finite`.
        """
        self.check_finite(late=True)
        if batch.device != self.device:  # a collector without a device of its own numbers its episodes on the host
            batch = to_device(batch, self.device)
        self._continuity.check(batch)
        self.schedule.frames += batch.numel()
        self.optimizer.set_learning_rate(self.learning_rate)
        try:
            transitions = self.extract(batch)
        except KeyError as error:
            raise ValueError(
                f"batch must hold all that environment and policy wrote, got one without an entry ({error.args[0]}); "
                "collect without compact_obs=True, and leave nothing out."
            ) from error
        self.replay.store(transitions)
        if self.schedule.frames_owed > 0 and (self.held or not self.replay.can_draw()):
            self.schedule.let_go()

    def updates_due(self) -> int:
        """How many updates are owed for the frames seen so far; none while no sequence can be drawn."""
        due = self.schedule.due
        return due if due and self.replay.can_draw() else 0

    def learn(self) -> dict[str, Tensor]:
        """Draws one minibatch and learns from it: :meth:`update` of :meth:`sample`, or both captured together."""
        return self.update(self.sample() if self.replay.draws is None else None)

    def sample(self) -> TensorDictBase:
        """One minibatch of sequences ``[batch_size, slice_len + lookahead]``."""
        return self.replay.sample()

    def update(self, sample: TensorDictBase | None) -> dict[str, Tensor]:
        """One gradient step on ``sample`` and one soft update of the target network.

        Args:
            sample: the minibatch; ``None``, where updates are captured: a new one, drawn by the device.

        Returns:
            Scalars without gradient: ``loss``, ``td_error``, ``q_value``, ``target``, ``trained_steps`` and, if
            gradients are clipped, ``grad_norm``.

        Raises:
            NonFiniteError: if loss or gradient is; the weights are as they were. On a GPU they are left alone, too, and
                :meth:`check_finite` raises it.
        """
        self.guard.begin(f"update {self.updates + 1}, frame {self.frames}")
        if sample is None and self.replay.draws is not None:
            self.replay.draws.refresh()
        if self._captured is None:
            report = self._gradient_step(sample, None)
        else:
            report = self._captured(sample, self._step.draw_ahead(self.replay.sequence_len))
        priority = report.pop("priority", None)
        self.schedule.updates += 1
        if self.settings.priority_exponent is not None and sample is not None:
            self.buffer.update_priority(sample["index"][:, 0], priority)
        return report

    def _gradient_step(self, sample: TensorDictBase | None, ahead: int | None) -> dict[str, Tensor]:
        """What is captured: the update, and the draw if there is no ``sample``."""
        if sample is not None:
            return self._step(sample, self.precision, ahead)
        assert self.replay.draws is not None
        sample = self.replay.draw()
        report = self._step(sample, self.precision, ahead)
        priority = report.pop("priority", None)
        if self.settings.priority_exponent is not None and priority is not None:
            self.replay.draws.set_priorities(sample, priority)
        return report

    @property
    def is_whole(self) -> bool:
        """Whether no update was cut off by an error while it changed weights."""
        return not self._step.changes

    def copy_to_target(self) -> None:
        """Makes the target network the same as the one that is trained."""
        HardUpdate(self.loss, value_network_update_interval=1).step()

    def check_finite(self, *, late: bool = False) -> None:
        """Looks at all updates since the last call, where :meth:`update` does not; :meth:`state_dict` calls it, too.

        Args:
            late: as :meth:`store`: without waiting for what was begun since the last such call.

        Raises:
            NonFiniteError: as :meth:`update`.
        """
        self.guard.check_late() if late else self.guard.check()

    def state_dict(self, *, memory: bool = True) -> dict[str, Any]:
        """All that learning depends on: both networks, optimiser, replay memory, counters.

        Args:
            memory: whether to include what :meth:`memory_state_dict` returns.
        """
        self.check_finite()
        rest = {
            "loss": self.loss.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "extract": self.extract.state_dict(),
            "precision": self.precision,
            **self.schedule.state_dict(),
        }
        return rest | self.memory_state_dict() if memory else rest

    def memory_state_dict(self) -> dict[str, Any]:
        """The replay memory, the minibatches drawn from it and when it is warm: large, and optional."""
        return self.replay.state_dict() | {"warm_at": self.schedule.warm_at}

    def load_memory_state_dict(self, state: dict[str, Any]) -> None:
        """Restores what :meth:`memory_state_dict` returned.

        A memory of earlier versions, which kept each observation twice, is left out, with a warning: the memory
        then begins empty and is warmed up again.
        """
        if self._captured is not None:
            self._captured.reset()
        if holds_inputs_twice(state["buffer"], self.loss.in_keys):
            warn_old_memory()
            self.begin_empty()
            return
        self.replay.load_state_dict(state)
        self.schedule.warm_at = state["warm_at"]

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restores what :meth:`state_dict` returned; without a memory it begins with an empty one and warms up again.

        Raises:
            ValueError: if it is not the state of a learner with these settings.
        """
        self.schedule.check(state, most_owed=max(self.settings.capacity, 1_000_000))
        self._continuity.reset()
        self.optimizer.load_state_dict(state["optimizer"])
        self.loss.load_state_dict(state["loss"])
        self.extract.load_state_dict(state["extract"])
        self.schedule.load_state_dict(state)
        if "buffer" in state:
            self.load_memory_state_dict(state)
        else:
            self.begin_empty()
        if self.settings.precision == "auto":  # another machine might choose another one
            self.precision = choose_precision(state.get("precision", "fp32"), self.network)

    def rewrite(self, change: Callable[..., None]) -> None:
        """Changes stored transitions (:meth:`Replay.rewrite`)."""
        self.replay.rewrite(change)

    def begin_empty(self) -> None:
        """Empties the memory; updates wait until it is warm again."""
        if self._captured is not None:
            self._captured.reset()
        self.replay.empty()
        self.schedule.warm_up_again()


def _memory_of(network: TensorDictModuleBase) -> NestedKey | None:
    """A recurrent state of a policy that goes on in each step: not of a level that decides now and then."""
    states = getattr(network, "state_keys", [])
    return states[0] if states and not hasattr(network, "gate_key") else None
