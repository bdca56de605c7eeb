import torch
from helpers import random_play

from hdrqn_torchrl.data import OptionExtractor, StepSelector


class TestStepSelector:
    def test_a_step_keeps_the_requested_entries_and_the_ends_of_the_episode(self):
        select = StepSelector(root_keys=["observation"], next_keys=["extra"])
        steps = random_play(2, 6)
        kept = select(steps)
        assert set(kept.keys(True, True)) == {
            "observation", ("collector", "traj_ids"), ("next", "extra"), ("next", "done"), ("next", "terminated"),
            ("next", "truncated"),
        }  # fmt: skip
        assert (kept["next", "extra"] == steps["next", "extra"]).all()

    def test_the_subgoal_of_a_step_is_the_one_in_force(self):
        steps = random_play(4, 30)
        kept = StepSelector(root_keys=["subgoal"], next_keys=[], subgoal_key="subgoal")(steps)
        assert (kept["subgoal"] == steps["next", "active_subgoal"]).all() and "subgoal" not in kept["next"]
        assert (kept["subgoal"] != steps["subgoal"]).any()  # random play proposes at every step

    def test_the_last_step_that_an_option_may_have_is_not_eligible(self):
        steps = random_play(4, 30)
        kept = StepSelector(root_keys=[], next_keys=[], option_limit=3)(steps)
        assert torch.equal(kept["eligible"], steps["next", "option_steps"] < 3) and not kept["eligible"].all()

    def test_the_batch_is_left_as_it_was(self):
        steps = random_play(2, 6)
        before = steps.clone()
        StepSelector(root_keys=["subgoal"], next_keys=["observation"], subgoal_key="subgoal")(steps)
        OptionExtractor()(steps)
        assert (steps == before).all()
