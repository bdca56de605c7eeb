"""Any Gymnasium environment with discrete actions as a task for all agents."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from multiprocessing import current_process
from typing import Any, Literal

import gymnasium
import torch
from gymnasium import spaces
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv, VectorEnv
from gymnasium.wrappers import TimeLimit

from hdrqn_torchrl import keys
from hdrqn_torchrl.envs.gym.arguments import (
    SomeSubgoals,
    action_names_of,
    actions_of,
    import_package_of,
    make_world,
    refuse_ignored,
    rule_of,
    stated_by,
    subgoals_of,
    wrappers_of,
)
from hdrqn_torchrl.envs.gym.environment import GymTaskEnv
from hdrqn_torchrl.envs.gym.given import check_given, checked_world, wrapped
from hdrqn_torchrl.envs.gym.masks import mask_entry_of, mask_place_of
from hdrqn_torchrl.envs.gym.observations import Channels, make_encoder
from hdrqn_torchrl.envs.gym.pools import pool_of, spec_of
from hdrqn_torchrl.envs.gym.returned import begun
from hdrqn_torchrl.envs.gym.vectors import GivenWorlds, OwnWorlds, PooledWorlds, Worlds
from hdrqn_torchrl.envs.gym.worlds import Reading, Rule, WorldWrapper
from hdrqn_torchrl.envs.task import Task

EnvFactory = Callable[[], gymnasium.Env]


def make_gym(
    id: str | EnvFactory | VectorEnv,
    num_envs: int = 16,
    *,
    subgoals: SomeSubgoals = None,
    settings: Mapping[str, Any] | None = None,
    package: str | None = None,
    wrappers: Sequence[Callable[[gymnasium.Env], gymnasium.Env] | str] = (),
    entries: Sequence[str] | None = None,
    channels: Channels | None = None,
    codes: int | Sequence[int] | None = None,
    words: Sequence[str] | None = None,
    text_length: int = 16,
    actions: Sequence[int] | None = None,
    reward: str | Rule | None = None,
    success: str | Rule | None = None,
    hazard: str | Rule | None = None,
    max_steps: int | None = None,
    largest_return: float | None = None,
    smallest_return: float | None = None,
    backend: Literal["gymnasium", "envpool"] = "gymnasium",
    processes: bool = False,
    seed: int | None = None,
    device: torch.device | str | None = None,
) -> GymTaskEnv:
    """N worlds of a Gymnasium environment, with the project's entries.

    What it shows becomes one tensor (:func:`~hdrqn_torchrl.envs.gym.make_encoder` says how). What it states in an
    attribute ``task``, a :class:`~hdrqn_torchrl.envs.Task`, holds as far as no argument says or changes it. Episodes
    that terminate are ``terminated``, those that a time limit ends are ``truncated``. Every episode has a seed of its
    own, drawn from ``seed``, so that a resumed training can play it again up to where it was.

    Strings that name something of a package (``"my_package.DoorSubgoals"``) are for settings: they are imported.

    Args:
        id: of a registered environment; or a function that makes one world; or a vector of worlds made elsewhere.
        num_envs: N.
        subgoals: a set of subgoals, or several from near to far; ``None``: agents of one level only.
        settings: keyword arguments for ``gymnasium.make``.
        package: that registers the id when it is imported, if it is none of
            :data:`~hdrqn_torchrl.envs.gym.arguments.PACKAGES`.
        wrappers: put around every world, the first one innermost; neither EnvPool's worlds nor a given vector take any.
        entries, channels, codes, words, text_length: of observations; see
            :func:`~hdrqn_torchrl.envs.gym.make_encoder`.
        actions: numbers of the actions that the agent has; ``None``: all.
        reward: in place of the environment's own: an entry of ``info``, or a function of (reward, info).
        success: whether a step completed the task, likewise; the function's ``info`` also has ``reward``,
            ``terminated`` and ``truncated``.
        hazard: what is to be avoided, likewise.
        max_steps: episodes are cut off then; ``None``: where the environment's own limit is.
        largest_return: of an episode, if known: it bounds the targets.
        smallest_return: likewise.
        backend: ``"envpool"`` steps the worlds in C++, if it has the id: ``pip install 'hdrqn_torchrl[envpool]'``. Its
            worlds can't be looked into, and a resumed training begins new episodes. Actions are masked as its entry
            ``action_mask`` or ``legal_action_mask`` of the observation or of ``info`` says.
        processes: each world has a process of its own.
        seed: of all episodes; ``None`` draws one from torch's global generator.
        device: device of all tensors.

    Raises:
        ImportError: if a package is missing.
        ValueError: if there is no such environment, it cannot be made, or an argument breaks its rule.

    Examples:
        >>> env = make_gym("CartPole-v1", num_envs=4, seed=0)
        >>> env.rollout(3)["observation"].shape
        torch.Size([4, 3, 4])
    """
    if processes and current_process().daemon:
        raise ValueError(
            "processes must be False in a worker of collector=processes, got True: it is a process itself and can't "
            "have others; raise collector.workers instead."
        )
    check_given(
        id,
        num_envs,
        settings=settings,
        package=package,
        wrappers=wrappers,
        actions=actions,
        max_steps=max_steps,
        seed=seed,
    )
    read = partial(
        _read,
        actions=actions,
        options={"entries": entries, "channels": channels, "codes": codes, "words": words, "text_length": text_length},
        rest={
            "subgoals": subgoals_of(subgoals),
            **{key: rule_of(key, rule) for key, rule in (("reward", reward), ("success", success), ("hazard", hazard))},
        },
    )
    ours = {"wrappers": wrappers, "package": package, "processes": processes}
    if isinstance(id, VectorEnv):
        other = None if backend == "gymnasium" else backend
        refuse_ignored(
            "a vector of worlds that was made elsewhere",
            {**ours, "settings": settings, "max_steps": max_steps, "backend": other},
            remedy="give it to what makes the vector",
        )
        made = _given(id, num_envs, read)
    elif backend == "envpool":
        refuse_ignored("backend='envpool'", ours, remedy="use backend='gymnasium', whose worlds are made here")
        made = _pooled(id, num_envs, read, {**(settings or {}), **_limit(max_steps)})
    elif backend == "gymnasium":
        made = _own(
            _factory(id, settings, package, wrappers_of(wrappers), max_steps), num_envs, read, processes=processes
        )
    else:
        raise ValueError(f"backend must be 'gymnasium' or 'envpool', got {backend!r}.")
    stated = made.stated
    if reward is not None or wrappers:
        stated = stated.without_returns()
    if actions is not None or wrappers:
        stated = replace(stated, symmetries=())
    if largest_return is None:
        largest_return = min(stated.largest_return, stated.largest_extrinsic_return)
    task = replace(
        stated.within(max_steps or made.max_steps),
        largest_return=largest_return,
        largest_extrinsic_return=largest_return,
        smallest_extrinsic_return=stated.smallest_extrinsic_return if smallest_return is None else smallest_return,
        subgoals=tuple(each.stated for each in made.reading.subgoals),
        success=keys.SUCCESS,
        actions=made.action_names,
    )
    return GymTaskEnv(
        made.worlds, num_envs=num_envs, actions=made.actions, reading=made.reading, task=task, render=made.render,
        seed=seed, device=device,
    )  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class _Made:
    """Worlds, and what was learned of them when they were made."""

    worlds: Worlds
    reading: Reading
    actions: tuple[int, ...]
    action_names: tuple[str, ...] = ()
    max_steps: int | None = None
    render: Callable[[], Any] | None = None
    stated: Task = field(default_factory=Task)


def _read(
    observed: spaces.Space,
    acted: spaces.Space,
    *,
    masked: bool,
    actions: Sequence[int] | None,
    options: Mapping[str, Any],
    rest: Mapping[str, Any],
) -> tuple[Reading, tuple[int, ...]]:
    """How entries are read, and the numbers of the agent's actions, for the spaces of one world."""
    numbers = actions_of(acted, actions)
    first, number = int(acted.start), int(acted.n)  # type: ignore[attr-defined]
    entry = None if masked else mask_entry_of(observed, number)
    places = tuple(each - first for each in numbers) if masked or entry else ()
    if entry is not None and options["entries"] is None:
        options = {**options, "entries": [name for name in observed if name != entry]}  # type: ignore[attr-defined]
    encoder = make_encoder(observed, **options)
    return Reading(encoder=encoder, masked_actions=places, mask_entry=entry, num_actions=number, **rest), numbers


def _own(make: Callable[..., gymnasium.Env], num_envs: int, read: Callable, *, processes: bool) -> _Made:
    """A vector of worlds that are made here."""
    probe = make()
    try:
        _, info = begun(probe, seed=0)
        reading, actions = read(probe.observation_space, probe.action_space, masked=keys.ACTION_MASK in info)
        names, limit, stated = action_names_of(probe, actions), _time_limit(probe), stated_by(probe)
        modes = probe.metadata.get("render_modes") or ()
    finally:
        probe.close()
    first = {"render_mode": "rgb_array"} if "rgb_array" in modes else {}
    worlds = [partial(_world, make, reading, first if index == 0 else {}) for index in range(num_envs)]
    vector: SyncVectorEnv | AsyncVectorEnv
    if processes and num_envs > 1:  # a single one, such as that of a picture, stays here
        vector = AsyncVectorEnv(worlds, autoreset_mode=AutoresetMode.DISABLED)
    else:
        vector = SyncVectorEnv(worlds, copy=False, autoreset_mode=AutoresetMode.DISABLED)
    return _Made(
        worlds=OwnWorlds(vector), reading=reading, actions=actions, action_names=names, max_steps=limit,
        render=partial(_picture, vector), stated=stated,
    )  # fmt: skip


def _world(make: Callable[..., gymnasium.Env], reading: Reading, settings: Mapping[str, Any]) -> gymnasium.Env:
    return WorldWrapper(make(**settings), reading)


def _picture(vector: SyncVectorEnv | AsyncVectorEnv) -> Any:
    """Of the first world, if it makes any."""
    first = vector.envs[0] if isinstance(vector, SyncVectorEnv) else None
    if first is not None:
        return first.render() if first.render_mode else None
    return vector.call("render")[0] if vector.get_attr("render_mode")[0] else None


def _factory(
    id: str | EnvFactory,
    settings: Mapping[str, Any] | None,
    package: str | None,
    wrappers: Sequence[Callable[[gymnasium.Env], gymnasium.Env]],
    max_steps: int | None,
) -> Callable[..., gymnasium.Env]:
    """A function that makes one world; it takes more settings for ``gymnasium.make``."""
    if isinstance(id, str):
        import_package_of(id, package)
        make = partial(_registered, id, dict(settings or {}), max_steps)
    elif settings or package:
        raise ValueError(
            f"settings and package must be left out with a function that makes worlds, got {settings}, {package!r}."
        )
    else:
        make = partial(_limited, id, max_steps)
    return partial(_wrapped, make, tuple(wrappers))


def _registered(id: str, settings: Mapping[str, Any], max_steps: int | None, **more: Any) -> gymnasium.Env:
    return make_world(id, {**settings, **more, **_limit(max_steps)})


def _limited(make: EnvFactory, max_steps: int | None, **_: Any) -> gymnasium.Env:
    env = checked_world(make(), "id, a function,", "one that")
    return env if max_steps is None else TimeLimit(env, max_steps)


def _wrapped(make: Callable[..., gymnasium.Env], wrappers: Iterable[Callable], **settings: Any) -> gymnasium.Env:
    env = make(**settings)
    for wrapper in wrappers:
        env = wrapped(env, wrapper)
    return env


def _given(vector: VectorEnv, num_envs: int, read: Callable) -> _Made:
    """A vector that was made elsewhere."""
    if vector.num_envs != num_envs:
        raise ValueError(f"num_envs must be that of the vector, {vector.num_envs}, got {num_envs}.")
    masked = keys.ACTION_MASK in vector.reset(seed=0)[1]
    reading, actions = read(vector.single_observation_space, vector.single_action_space, masked=masked)
    limit = getattr(vector.spec, "max_episode_steps", None)
    return _Made(worlds=GivenWorlds(vector, reading), reading=reading, actions=actions, max_steps=limit)


def _pooled(id: str | EnvFactory, num_envs: int, read: Callable, settings: Mapping[str, Any]) -> _Made:
    """Worlds of EnvPool."""
    spec = spec_of(id, num_envs, settings)
    mask, limit = mask_place_of(spec), spec.config.max_episode_steps
    space = spec.gymnasium_observation_space
    reading, actions = read(space, spec.gymnasium_action_space, masked=mask is not None)
    make = partial(pool_of, str(id), num_envs, dict(settings))
    worlds = PooledWorlds(make, reading, num_envs, space=space, mask=mask)
    return _Made(worlds=worlds, reading=reading, actions=actions, max_steps=limit if 0 < limit < 2**31 - 1 else None)


def _limit(max_steps: int | None) -> dict[str, Any]:
    return {} if max_steps is None else {"max_episode_steps": max_steps}


def _time_limit(env: gymnasium.Env) -> int | None:
    """The shortest one among an environment's wrappers."""
    limits = [env._max_episode_steps] if isinstance(env, TimeLimit) else []
    if isinstance(env, gymnasium.Wrapper):
        limits += [_time_limit(env.env) or 0]
    return min((limit for limit in limits if limit), default=None)
