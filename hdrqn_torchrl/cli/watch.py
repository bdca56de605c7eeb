"""Records episodes of a trained agent: the world, what the agent sees, wants and does, and the Q-values of every level.

    python watch.py run=RUN_DIR out=episode.gif
    python watch.py run=RUN_DIR out=terminal env.layout=four_rooms epsilon=0.1
    python watch.py run=RUN_DIR out=subgoals.png episodes=50

run              folder of a training
out              what to write, by ending: .gif or .mp4 (needs PyAV), or terminal to watch at once (default
                 episode.gif); .png: a sheet of the agent's subgoals, with moments in which they were attained
episodes         how many, one after the other (default 3)
seed             of worlds and exploration; the same seed shows the same episodes (default 0)
checkpoint       best (default), last, or the path of a checkpoint or weights file
epsilon          probability of a random choice, at every level (default 0: greedy)
fps              steps a second (default 4)
env.KEY          a setting of the task to change from the run's: env.view, env.obstacle, env.max_steps, ...
allowed_targets  builders of your own that the run may name: [package.builder]
"""

from __future__ import annotations

from hdrqn_torchrl.cli.command_line import command_line
from hdrqn_torchrl.cli.recording import Settings, run


def main() -> None:
    """Runs with the arguments of the command line."""
    command_line(Settings, __doc__ or "", run)
