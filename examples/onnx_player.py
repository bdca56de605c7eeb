"""Plays an exported agent with onnxruntime and numpy alone, one decision a step.

    python export.py run=RUN_DIR out=agent.onnx
    python examples/onnx_player.py agent.onnx hdrqn_torchrl.envs.gym:hdrqn/Gridworld-v0 10

The task may be any that Gymnasium can make. One with subgoals says in its info which of them a step attained.
"""

import json
import sys

import gymnasium
import numpy as np
import onnxruntime

session = onnxruntime.InferenceSession(sys.argv[1])
about = json.loads(session.get_modelmeta().custom_metadata_map["hdrqn_torchrl"])
types = {"tensor(float)": np.float32, "tensor(int64)": np.int64, "tensor(bool)": np.bool_, "tensor(uint8)": np.uint8}
inputs = {each.name: np.zeros([1, *each.shape[1:]], types[each.type]) for each in session.get_inputs()}
names = [each.name for each in session.get_outputs()]

env = gymnasium.make(sys.argv[2])
for episode in range(int(sys.argv[3])):
    (observation, info), done, rewards, reached = env.reset(seed=episode), False, [], False
    while not done:
        inputs |= {"observation": np.asarray(observation)[None], "is_init": np.array([[not rewards]])}
        inputs |= {name: np.asarray(info[name]).reshape(1, -1) for name in about["observed"] if name in info}
        if "available" in about["observed"] and "available" not in info:
            reached = reached | inputs["attained"]
            inputs["available"] = ~reached  # subgoals that can be attained once in an episode
        outputs = dict(zip(names, session.run(None, inputs), strict=True))
        inputs |= {name: outputs["next_" + name] for name in about["state"]}  # this is all that it remembers
        observation, reward, terminated, truncated, info = env.step(about["actions"][outputs["action"][0]])
        rewards.append(float(reward))
        done = terminated or truncated
    print(f"episode {episode}: return {sum(rewards):.2f} in {len(rewards)} steps")
