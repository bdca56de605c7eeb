"""Agents of every kind with wild weights, so that their greedy play goes somewhere and their options end."""

import torch
from helpers import build, house, small_env, tiny_settings
from user_envs import Corridor

from hdrqn_torchrl.discovery import DiscoverySettings
from hdrqn_torchrl.envs import make_gym
from hdrqn_torchrl.modules import compact_network, paper_network

KINDS = {
    "dqn": ("dqn", small_env, {}),
    "drqn": ("drqn", small_env, {}),
    "hdqn": ("hdqn", small_env, {}),
    "v1": ("v1", small_env, {}),
    "v2": ("v2", small_env, {}),
    "v2 that reads the last observation": ("v2", small_env, {"meta_input_time": "after_last_observation"}),
    "v2 with short options": ("v2", small_env, {"max_option_steps": 3}),
    "v1 with three levels": ("v1", house, {"levels": 3}),
    "v2 with three levels": ("v2", house, {"levels": 3}),
    "v3 with one level": ("v3", small_env, {"levels": 1}),
    "v3": ("v3", small_env, {}),
    "v3 with symmetries": ("v3", small_env, {"symmetries": True}),
    "v3 with three levels": ("v3", house, {"levels": 3}),
    "v3 that finds its subgoals": ("v3", small_env, {"subgoals": "discovered"}),
    "masked actions": ("v2", lambda number, **_: Corridor(number, length=12, masked=True), {}),
    "codes": ("drqn", lambda number, **_: make_gym("FrozenLake-v1", number), {}),
    "images": ("v2", small_env, {"architecture": paper_network()}),
}


def make_agent(kind, num_envs=50, *, max_steps=25):
    """The agent and its environment."""
    name, worlds, options = KINDS[kind]
    torch.manual_seed(1)
    env = worlds(num_envs, max_steps=max_steps)
    settings = tiny_settings()
    options = dict(options)
    if options.get("subgoals") == "discovered":
        options["discovery"] = DiscoverySettings(max_subgoals=3, warmup_frames=2_000)
    algorithm = build(name, env, options.pop("architecture", compact_network(8, (8,))), settings=settings, **options)
    for parameter in algorithm.policy.parameters():
        torch.nn.init.normal_(parameter, std=0.1 if kind == "images" else 0.7)
    if hasattr(algorithm.policy, "critic"):
        teach(algorithm.policy.critic)
    return algorithm, algorithm.transform(env)


def teach(critic):
    """Goals that are taken become subgoals, as random play shows them."""
    play = small_env(32, num_obstacles=0, max_steps=16).rollout(125, break_when_any_done=False)
    for batch in play.split(10, 1):
        critic.detector.observe(batch["observation"], batch["action"], batch["next", "observation"])
    tokens = critic.detector(play["observation"], play["action"], play["next", "observation"]).unique()
    taken = {token: slot for slot, token in enumerate(tokens[tokens > 0].tolist(), start=1)}
    critic.table.assign(taken, once=tuple(taken.values()))
