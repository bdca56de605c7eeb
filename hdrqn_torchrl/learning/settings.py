"""How one level of the agent learns: what is replayed, how often, and towards which targets."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from typing import Literal

from hdrqn_torchrl.data import FROM_STARTS, Sampling
from hdrqn_torchrl.learning.captured import Capture
from hdrqn_torchrl.learning.precision import Precision
from hdrqn_torchrl.modules.sizes import check_number, check_size
from hdrqn_torchrl.objectives import check_returns, target_lookahead

_LARGEST_SCALE = 10_000


@dataclass(frozen=True, kw_only=True)
class LearnerSettings:
    """How one level learns. The defaults are those that ``conf/algo/learner/`` has, and train the grid tasks well.

    The paper states other values for some of them: ``tau=0.001``, a constant learning rate and no clipping of gradients
    (``experiment=as_in_paper`` has them all).

    :class:`~hdrqn_torchrl.learning.learner.Learner` reads the settings of replay and optimiser. ``burn_in``,
    ``train_exact_states``, ``stored_state``, ``loss_function``, ``double``, ``max_target``, ``trace_decay`` and
    ``n_step`` are settings of the loss, to which :func:`~hdrqn_torchrl.algorithms.make_recurrent_loss` and the builders
    of algorithms pass them; a learner refuses a loss that was built with others than those that are not the defaults.

    Args:
        slice_len: n, number of transitions in a replayed sequence (steps at the sub level, options at the meta level).
            Transitions beyond them that the targets need are also drawn (:meth:`lookahead`). ``None``, for v3 only:
            what suits the task (see :func:`~hdrqn_torchrl.algorithms.make_v3`).
        batch_size: number of sequences in a minibatch.
        batch_scale: minibatches are so many times as large, and updates so many times as rare: each step is replayed as
            often. Rates of Adam and of the target network change with it (:meth:`scaled`). For many worlds on a GPU,
            which takes a large minibatch in little more time than a small one.
        capacity: number of transitions that the replay memory holds.
        frames_per_update: environment frames between two updates; 0.5 is two updates a frame.
        warmup_frames: environment frames before the first update.
        learning_rate: of Adam.
        learning_rate_end: the value to which it falls linearly; ``None``: it stays constant.
        learning_rate_frames: environment frames until then; give those of the whole training. The default is that of
            ``total_frames`` in ``conf/``.
        tau: rate of the soft target update.
        max_grad_norm: gradients are clipped to this norm; ``None``: they are not clipped. It should be above the usual
            norm (``grad_norm`` of a log), or rare surprises hardly count; the default is for returns of a few units.
        burn_in: share of a sequence, at its beginning, that is left out of the loss and only warms up the recurrent
            state. (Gradients flow back through it, so that what is remembered there is also learned.) Ignored without
            memory.
        train_exact_states: train those of its steps whose recurrent state is exact (see
            :func:`~hdrqn_torchrl.objectives.training_mask`).
        stored_state: store the recurrent state that the acting policy had at each step, and start sequences from it
            instead of from zero (R2D2; Kapturowski et al., 2019). Costs 8 H bytes a step.
        sampling: how sequences are drawn (see :func:`~hdrqn_torchrl.data.make_sequence_buffer`).
        priority_exponent: alpha: draw sequences in proportion to ``priority**alpha``, with the priority that the loss
            reports; R2D2 has 0.9. ``None``: uniformly.
        importance_exponent: beta: weights ``priority**(-alpha * beta)`` correct for it in the loss; 1: in full.
        loss_function: ``"l2"``, or ``"smooth_l1"``, for which an error of 100 counts no more than 100 errors of 1.
        double: Double DQN.
        max_target: largest possible return; targets are clipped to it. ``None``: what the task states, if anything;
            ``"unbounded"``: no clipping, not even to the smallest return that the task states.
        trace_decay: lambda of Q(lambda) with Watkins' cut, along the sequence; 0: one-step targets.
        n_step: number of rewards in a target; 1: one-step targets.
        precision: ``"fp32"``, ``"bf16"`` or ``"auto"`` (:func:`~hdrqn_torchrl.learning.precision.choose_precision`).
        capture: whether updates are captured as graphs of the GPU; ``"auto"``: where there is one
            (:func:`~hdrqn_torchrl.learning.captured.wants_capture`).

    Raises:
        ValueError: if a value breaks its rule.

    Examples:
        >>> settings = LearnerSettings(slice_len=8, batch_size=16, n_step=3)
        >>> settings.lookahead()  # what targets of three rewards need beyond slice_len
        2
        >>> LearnerSettings(slice_len=0)
        Traceback (most recent call last):
        ...
        ValueError: slice_len must be >= 1, got 0; use 1 for a feed-forward network.
    """

    slice_len: int | None = 8
    batch_size: int = 32
    batch_scale: int = 1
    capacity: int = 100_000
    frames_per_update: float = 8.0
    warmup_frames: int = 5_000
    learning_rate: float = 1e-3
    learning_rate_end: float | None = 1e-4
    learning_rate_frames: int = 800_000
    tau: float = 3e-3
    max_grad_norm: float | None = 10.0
    burn_in: float = 0.5
    train_exact_states: bool = True
    stored_state: bool = False
    sampling: Sampling = "steps"
    priority_exponent: float | None = None
    importance_exponent: float = 0.6
    loss_function: Literal["l2", "smooth_l1"] = "l2"
    double: bool = True
    max_target: float | Literal["unbounded"] | None = None
    trace_decay: float = 0.0
    n_step: int = 1
    precision: Precision | Literal["auto"] = "fp32"
    capture: Capture = "auto"

    def __post_init__(self) -> None:
        for each in fields(self):
            value, usual = getattr(self, each.name), each.default
            if isinstance(usual, int | float) and not isinstance(usual, bool) and value is not None:
                check_number(each.name, value, usual)
        check_returns(self.trace_decay, self.n_step)
        slice_len = 2 if self.slice_len is None else self.slice_len
        rules = (
            ("slice_len", slice_len >= 1, ">= 1", "use 1 for a feed-forward network"),
            ("batch_size", self.batch_size >= 1, ">= 1", "use 32"),
            ("batch_scale", 1 <= self.batch_scale <= _LARGEST_SCALE, f"in [1, {_LARGEST_SCALE:,}]", "use 1"),
            ("capacity", self.capacity >= slice_len, ">= slice_len", "use 100000 for steps, 50000 for options"),
            ("frames_per_update", self.frames_per_update > 0, "> 0", "use 8"),
            ("warmup_frames", self.warmup_frames >= 0, ">= 0", "use 5000"),
            ("learning_rate", self.learning_rate > 0, "> 0", "the paper uses 0.001"),
            (
                "learning_rate_end",
                self.learning_rate_end is None or 0 < self.learning_rate_end <= self.learning_rate,
                f"in (0, learning_rate={self.learning_rate}] or None",
                "use None for a constant rate",
            ),
            ("learning_rate_frames", self.learning_rate_frames >= 1, ">= 1", "use the frames of the whole training"),
            ("burn_in", 0 <= self.burn_in < 1, "in [0, 1)", "the paper's last-half rule is 0.5"),
            ("tau", 0 < self.tau <= 1, "in (0, 1]", "the paper uses 0.001"),
            (
                "train_exact_states",
                self.train_exact_states or not (self.burn_in and self.sampling in FROM_STARTS),
                f"True with burn_in={self.burn_in} and sampling={self.sampling!r}",
                "otherwise the first steps of an episode are never trained; or use burn_in=0",
            ),
            (
                "stored_state",
                not (self.stored_state and self.sampling in FROM_STARTS),
                f"False with sampling={self.sampling!r}",
                "all its sequences begin where an episode does, and there the state is zero",
            ),
            (
                "priority_exponent",
                self.priority_exponent is None or 0 < self.priority_exponent <= 1,
                "in (0, 1] or None",
                "use 0.9, or None to draw uniformly",
            ),
            ("importance_exponent", 0 <= self.importance_exponent <= 1, "in [0, 1]", "use 0.6"),
            ("max_grad_norm", self.max_grad_norm is None or self.max_grad_norm > 0, "> 0 or None", "use 10"),
            (
                "slice_len",
                not self.trace_decay or slice_len > 1,
                "> 1 where trace_decay > 0",
                "a sequence of one transition has no next target to take over",
            ),
        )
        for name, holds, rule, remedy in rules:
            if not holds:
                raise ValueError(f"{name} must be {rule}, got {getattr(self, name)}; {remedy}.")

    def scaled(self) -> LearnerSettings:
        """The same settings without ``batch_scale``: what it means is in the others.

        The target network follows as fast in frames as without it, and Adam's rate grows with the root of the scale, as
        the noise of gradients falls by it (Malladi et al., 2022).

        Examples:
            >>> settings = LearnerSettings(batch_size=32, frames_per_update=20, batch_scale=4).scaled()
            >>> settings.batch_size, settings.frames_per_update
            (128, 80)
        """
        if self.batch_scale == 1:
            return self
        scale, end = self.batch_scale, self.learning_rate_end
        return replace(
            self,
            batch_size=scale * self.batch_size,
            frames_per_update=scale * self.frames_per_update,
            learning_rate=self.learning_rate * math.sqrt(scale),
            learning_rate_end=None if end is None else end * math.sqrt(scale),
            tau=1.0 - (1.0 - self.tau) ** scale,
            batch_scale=1,
        )

    def rate_at(self, frames: int) -> float:
        """Adam's rate after so many frames."""
        start, end = self.learning_rate, self.learning_rate_end
        progress = min(1.0, frames / self.learning_rate_frames)
        return start if end is None else start + (end - start) * progress

    def lookahead(self, trace_decay: float | None = None) -> int:
        """Number of transitions drawn beyond ``slice_len``, so that targets are not cut short.

        Q(lambda) needs none in sequences from the start of an episode, which are meant to cover all of it.

        Args:
            trace_decay: lambda; ``None``: that of these settings.

        Raises:
            ValueError: if ``slice_len`` is ``None``.
        """
        decay = self.trace_decay if trace_decay is None else trace_decay
        if self.slice_len is None:
            raise ValueError("slice_len must be a number, got None; only v3 asks the task how long an episode is.")
        return target_lookahead(0.0 if self.sampling in FROM_STARTS else decay, self.n_step, self.slice_len)

    def lasting(self, total_frames: int | None) -> LearnerSettings:
        """The same settings for a training of ``total_frames``: the learning rate falls until its end.

        Args:
            total_frames: environment frames of the whole training; ``None``: no change.

        Raises:
            ValueError: if ``total_frames`` is no whole number from 1 on.

        Examples:
            >>> LearnerSettings().lasting(200_000).learning_rate_frames
            200000
        """
        if total_frames is not None:
            check_size("total_frames", total_frames, "the frames of the whole training")
        return self if total_frames is None else replace(self, learning_rate_frames=total_frames)
