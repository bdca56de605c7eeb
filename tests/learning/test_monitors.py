import torch
from tensordict import TensorDict

from hdrqn_torchrl.learning import VisitCounter


def batch(*steps):
    """One environment ``[1, T]``; each step is (attained, done)."""
    attained, done = (torch.tensor(column)[None] for column in zip(*steps, strict=True))
    return TensorDict({"next": {"attained": attained, "done": done[..., None]}}, [1, len(steps)])


NONE, FIRST, BOTH = [False, False], [True, False], [True, True]


class TestVisitCounter:
    def columns(self, visits):
        row = visits.metrics()
        return [row[f"behaviour/{name}"] for name in ("attained_0", "visits_0", "attained_1", "visits_1")]

    def test_attained_counts_episodes_and_visits_how_often(self):
        visits = VisitCounter()
        visits.observe(batch((FIRST, False), (FIRST, True), (NONE, True), (BOTH, False)))
        assert self.columns(visits) == [0.5, 1.0, 0.0, 0.0]

    def test_a_new_row_forgets_episodes_that_ended_and_keeps_those_in_progress(self):
        visits = VisitCounter()
        visits.observe(batch((FIRST, True), (BOTH, False)))
        visits.clear()
        assert visits.metrics() == {}
        visits.observe(batch((FIRST, True)))
        assert self.columns(visits) == [1.0, 2.0, 1.0, 1.0]

    def test_a_restored_visit_counter_continues(self):
        visits, other = VisitCounter(), VisitCounter()
        visits.observe(batch((BOTH, True), (FIRST, False)))
        other.load_state_dict(visits.state_dict())
        for each in (visits, other):
            each.observe(batch((FIRST, True)))
        assert self.columns(other) == self.columns(visits) == [1.0, 1.5, 0.5, 0.5]

    def test_an_episode_that_was_lost_does_not_count_for_the_next(self):
        """Workers that fail begin new episodes."""
        visits = VisitCounter()
        visits.observe(batch((BOTH, False)))
        for begins, expected in ((True, [1.0, 1.0, 0.0, 0.0]), (False, [1.0, 1.0, 0.0, 0.0])):
            following = batch((FIRST, False))
            visits.observe(following.set("is_init", torch.tensor([[[begins]]])))
            visits.observe(batch((NONE, True)).set("is_init", torch.tensor([[[False]]])))
            assert self.columns(visits) == expected
            visits.clear()
