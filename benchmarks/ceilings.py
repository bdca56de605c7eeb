"""Measures the scripted players on the paper's tasks and prints the rows of ``MEASURED`` in envs/grid/measured.py."""

import torch

from hdrqn_torchrl.envs.grid.ceilings import measure, standard_tasks
from hdrqn_torchrl.envs.grid.measured import MEASURED_EPISODES

if __name__ == "__main__":
    torch.set_num_threads(1)
    for task in standard_tasks():
        result = measure(task, MEASURED_EPISODES)
        figures = "{return_mean:.3f}, {success_rate:.4f}, {steps_mean:.1f}".format(**result)
        print(f"    Task{tuple(task)}: ({figures}),".replace("'", '"'), flush=True)
