"""Players of MiniGrid's tasks that mark what can be achieved: the BabyAI bot, and chance."""

from __future__ import annotations

from collections.abc import Callable
from time import monotonic
from typing import Any

import gymnasium
import numpy as np

_FAILS_ON = ("UnlockToUnlock", "KeyInBox", "Carrying", "ObstructedMaze")
"""Parts of ids of tasks that the bot never ends, or gives up: keys in boxes, doors behind balls."""

Act = Callable[[], int]


def bot_can_play(env: gymnasium.Env, id: str) -> bool:
    """Whether the bot plays a task: it needs an instruction, a goal to reach, or one thing to pick up."""
    env.reset(seed=0)
    return not any(part in id for part in _FAILS_ON) and _instruction(env.unwrapped) is not None


def play(
    make: Callable[[], gymnasium.Env], player: str, seconds: float | None, *, episodes: int = 100
) -> dict[str, float]:
    """Plays whole episodes.

    Args:
        make: makes one world.
        player: ``"bot"`` or ``"random"``.
        seconds: how long it may take; ``None``: as long as it takes.
        episodes: number of them.

    Returns:
        ``return_mean``, ``success_rate``, ``steps_mean`` (of all episodes) and ``episodes``.

    Raises:
        TimeoutError: if the time is up.
    """
    end = None if seconds is None else monotonic() + seconds
    env, returns, lengths, successes = make(), [], [], 0
    for seed in range(episodes):
        env.reset(seed=seed)
        act = _bot(env) if player == "bot" else _chance(env, seed)
        total, steps, over = 0.0, 0, False
        while not over:
            if end is not None and monotonic() > end:
                raise TimeoutError(f"{seed} of {episodes} episodes took {seconds:g} seconds.")
            _, reward, terminated, truncated, _ = env.step(act())
            total, steps, over = total + float(reward), steps + 1, terminated or truncated
        returns.append(total)
        lengths.append(steps)
        successes += total > 0
    env.close()
    return {
        "return_mean": float(np.mean(returns)),
        "success_rate": successes / episodes,
        "steps_mean": float(np.mean(lengths)),
        "episodes": episodes,
    }


def _chance(env: gymnasium.Env, seed: int) -> Act:
    generator, number = np.random.default_rng(seed), int(env.action_space.n)  # type: ignore[attr-defined]
    return lambda: int(generator.integers(number))


def _bot(env: gymnasium.Env) -> Act:
    """MiniGrid's bot with full knowledge; where it thinks that all is done, it walks on."""
    from minigrid.utils.baby_ai_bot import BabyAIBot, GoNextToSubgoal

    world: Any = env.unwrapped
    instruction = _instruction(world)

    class Bot(BabyAIBot):
        def _process_instr(self, instr: Any) -> None:
            if isinstance(instr, tuple):
                self.stack.append(GoNextToSubgoal(self, instr))
            else:
                super()._process_instr(instr)

    world.instrs = instruction
    if not hasattr(world, "room_from_pos"):  # the bot asks for it, and needs no room
        world.room_from_pos = lambda x, y: None
    for index, cell in enumerate(world.grid.grid):
        if cell is not None and cell.cur_pos is None:  # MultiRoom's doors do not know where they are
            cell.cur_pos = (index % world.grid.width, index // world.grid.width)
    bot = Bot(env)

    def act() -> int:
        action = bot.replan()
        return int(world.actions.forward if action == world.actions.done else action)

    return act


def _instruction(world: Any) -> Any:
    """What the bot is to do: the task's own instruction, the place of the goal, or the thing to pick up."""
    from minigrid.envs.babyai.core.roomgrid_level import RoomGridLevel
    from minigrid.envs.babyai.core.verifier import ObjDesc, PickupInstr

    if isinstance(world, RoomGridLevel):
        return world.instrs  # type: ignore[attr-defined]
    cells = list(enumerate(world.grid.grid))
    goals = [
        (index % world.grid.width, index // world.grid.width) for index, cell in cells if cell and cell.type == "goal"
    ]
    if len(goals) == 1:
        return goals[0]
    words = world.mission.split()
    if words[:2] != ["pick", "up"]:
        return None
    instruction = PickupInstr(ObjDesc(words[-1], words[-2] if len(words) > 4 else None))
    instruction.reset_verifier(world)
    return instruction
