"""Every algorithm, and an agent that always walks right through a corridor, past things whose places are known."""

from dataclasses import replace

import torch
from helpers import AGENT, CORRIDOR, OBJECTS, RIGHT, build

from hdrqn_torchrl.algorithms import make_v3
from hdrqn_torchrl.envs import MultiGoalGridEnv
from hdrqn_torchrl.modules import compact_network
from hdrqn_torchrl.rendering import record_episodes

FLAT, TWO_LEVELS = ("dqn", "drqn"), ("hdqn", "v1", "v2", "v3")
FIRST_GOAL, SECOND_GOAL = (1.0, 0.5), (0.25, 1.0)  # Q^M of agents that want this goal before the other


def make_agent(name, env):
    """An untrained small agent of any kind."""
    if name == "v3":
        return make_v3(env, compact_network(8, (8,)), memory_size=8, head_size=8)
    return build(name, env)


def prefer(network, values):
    """Makes a Q-network answer ``values``, whatever it sees."""
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.zero_()
        network.head.streams.bias[1:] = torch.tensor(values)
        network.head.streams.bias[0] = sum(values) / len(values)


def walk(name="v2", *, objects=OBJECTS, wants=FIRST_GOAL, options=None, recording=None, **settings):
    """Frames of ``name`` walking right; by default it meets an obstacle, goal 1 and goal 2, one a step."""
    defaults = {"layout": CORRIDOR, "num_obstacles": 1, "view": 3, "max_steps": 9}
    env = MultiGoalGridEnv(1, **(defaults | settings))
    env.rules.sample = lambda *_: env.rules.place(AGENT, objects)
    agent = build(name, env, **(options or {}))
    actions = [0.0, -0.125, 0.25, 0.25]
    actions[RIGHT] = 0.5
    if name in FLAT:
        prefer(agent.policy.network, actions)
    else:
        prefer(agent.policy.sub_controller.network, actions)
        prefer(agent.policy.meta_controller.network, wants)
    return record_episodes(agent.transform(env), agent, **(recording or {}))


def with_values(frame, values, *, allowed=None, choice=0):
    """The frame with other Q-values of the actions."""
    allowed = allowed or (True,) * len(values)
    return replace(frame, action=replace(frame.action, values=values, allowed=allowed, choice=choice))
