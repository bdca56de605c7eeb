import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Unbounded
from torchrl.envs.utils import ExplorationType, set_exploration_type

from hdrqn_torchrl import algorithms
from hdrqn_torchrl.envs import MultiGoalGridEnv
from hdrqn_torchrl.modules import EpsilonGreedy, RepeatingEpsilonGreedy, SuccessEpsilonGreedy, compact_network
from hdrqn_torchrl.modules.exploration import choose, mask_values

VALUES = torch.tensor([3.0, 9.0, 1.0, 5.0])


@pytest.mark.parametrize(
    ("frames", "epsilon"), [(0, 1.0), (1, 0.991), (50, 0.55), (99, 0.109), (100, 0.1), (101, 0.1), (10**9, 0.1)]
)
def test_epsilon_falls_linearly_and_then_stays(frames, epsilon):
    exploration = EpsilonGreedy(1.0, 0.1, anneal_frames=100)
    exploration.step(frames)
    assert exploration.epsilon.item() == pytest.approx(epsilon)


def test_the_schedule_adds_up_over_batches():
    exploration = EpsilonGreedy(0.8, 0.2, anneal_frames=60)
    for _ in range(3):
        exploration.step(10)
    assert exploration.epsilon.item() == pytest.approx(0.5)


def test_the_share_of_random_choices_is_epsilon():
    torch.manual_seed(0)
    exploration = EpsilonGreedy(0.4, 0.4)
    with set_exploration_type(ExplorationType.RANDOM):
        choices, _ = exploration(VALUES.expand(40_000, 4))
    shares = choices.bincount(minlength=4) / len(choices)
    assert shares.tolist() == pytest.approx([0.1, 0.7, 0.1, 0.1], abs=0.01)


def test_every_row_draws_for_itself():
    torch.manual_seed(0)
    with set_exploration_type(ExplorationType.RANDOM):
        choices, _ = EpsilonGreedy(1.0, 1.0)(VALUES.expand(5, 200, 4))
    assert choices.shape == (5, 200)
    assert all(row.unique().tolist() == [0, 1, 2, 3] for row in choices)


@pytest.mark.parametrize("kind", [ExplorationType.DETERMINISTIC, ExplorationType.MODE, ExplorationType.MEAN])
def test_any_other_exploration_type_is_greedy(kind):
    with set_exploration_type(kind):
        assert (EpsilonGreedy(1.0, 1.0)(VALUES.expand(500, 4))[0] == 1).all()


class TestMask:
    MASK = torch.tensor([True, False, True, False])

    def test_greedy_takes_the_best_that_is_allowed(self):
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            assert EpsilonGreedy()(VALUES, mask=self.MASK)[0].item() == 0

    def test_exploring_takes_all_that_are_allowed_and_only_those(self):
        torch.manual_seed(0)
        with set_exploration_type(ExplorationType.RANDOM):
            choices, _ = EpsilonGreedy(1.0, 1.0)(VALUES.expand(2_000, 4), mask=self.MASK.expand(2_000, 4))
        shares = choices.bincount(minlength=4) / len(choices)
        assert shares.tolist() == pytest.approx([0.5, 0.0, 0.5, 0.0], abs=0.05)

    @pytest.mark.parametrize("kind", [ExplorationType.RANDOM, ExplorationType.DETERMINISTIC])
    def test_a_row_that_allows_nothing_allows_everything(self, kind):
        torch.manual_seed(0)
        mask = torch.tensor([[False] * 4, [False, False, True, False]]).repeat(500, 1)
        with set_exploration_type(kind):
            choices, _ = EpsilonGreedy(1.0, 1.0)(VALUES.expand(1_000, 4), mask=mask)
        assert choices[::2].unique().tolist() == ([0, 1, 2, 3] if kind == ExplorationType.RANDOM else [1])
        assert (choices[1::2] == 2).all()

    def test_masked_values_are_minus_infinity_unless_nothing_is_allowed(self):
        inf = float("inf")
        masked = mask_values(torch.tensor([[1.0, 2.0], [1.0, 2.0]]), torch.tensor([[True, False], [False, False]]))
        assert masked.tolist() == [[1.0, -inf], [1.0, 2.0]]


def test_the_schedule_travels_in_the_state_dict():
    source, copy = EpsilonGreedy(1.0, 0.0, anneal_frames=100), EpsilonGreedy(1.0, 0.0, anneal_frames=100)
    source.step(30)
    copy.load_state_dict(source.state_dict())
    assert copy.epsilon.item() == pytest.approx(0.7)
    copy.step(10)
    assert copy.epsilon.item() == pytest.approx(0.6)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"start": 1.5}, r"start must be an epsilon in \[0, 1\], got 1.5; "),
        ({"start": "1.0"}, r"start must be a number, got '1.0'; use 1.0"),
        ({"ladder": None}, "ladder must be a number, got None; use 0.0"),
        ({"end": -0.1}, r"end must be an epsilon in \[0, 1\], got -0.1; "),
        ({"anneal_frames": 0}, "anneal_frames must be >= 1, got 0; "),
    ],
)
def test_values_out_of_range_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        EpsilonGreedy(**arguments)


class TestLadder:
    @pytest.mark.parametrize("kind", [EpsilonGreedy, RepeatingEpsilonGreedy])
    def test_epsilon_of_each_environment(self, kind):
        exploration = kind(0.5, 0.5, ladder=3.0)
        assert exploration.epsilons(torch.zeros(4)).tolist() == pytest.approx([0.5, 0.25, 0.125, 0.0625])
        assert exploration.epsilons(torch.zeros(1)).tolist() == [0.5]
        assert exploration.epsilons(torch.zeros(3, 7)).flatten().tolist() == pytest.approx([0.5, 0.5**2.5, 0.0625])
        assert exploration.epsilons(torch.tensor(0.0)).item() == 0.5

    def test_without_a_ladder_all_environments_have_the_same_epsilon(self):
        assert EpsilonGreedy(0.5, 0.5).epsilons(torch.zeros(4)).item() == 0.5

    def test_the_rungs_move_with_the_schedule(self):
        exploration = EpsilonGreedy(1.0, 0.0, anneal_frames=100, ladder=1.0)
        assert exploration.epsilons(torch.zeros(2)).tolist() == [1.0, 1.0]
        exploration.step(50)
        assert exploration.epsilons(torch.zeros(2)).tolist() == pytest.approx([0.5, 0.25])

    def test_the_share_of_random_choices_of_each_environment(self):
        values = torch.cat([torch.ones(1), torch.zeros(99)])
        with set_exploration_type(ExplorationType.RANDOM):
            choices, _ = EpsilonGreedy(0.5, 0.5, ladder=1.0)(values.expand(2, 20_000, 100))
        assert (choices != 0).float().mean(1).tolist() == pytest.approx([0.495, 0.2475], abs=0.02)

    def test_a_negative_ladder_is_refused(self):
        with pytest.raises(ValueError, match=r"ladder must be >= 0 and finite, got -1\.0; "):
            EpsilonGreedy(ladder=-1.0)


class Alternating(EpsilonGreedy):
    """Takes every choice in turn, whatever it is worth: an exploration of a user's own, which carries a count."""

    carried_spec = Unbounded(shape=(1,), dtype=torch.int64)

    def forward(self, values, *, mask=None, condition=None, starts=None, carried=None):
        return carried.squeeze(-1) % values.shape[-1], carried + 1


class TestChoose:
    def test_what_an_exploration_carries_is_read_and_written_under_the_key_given(self):
        root = TensorDict({("a", "count"): torch.tensor([[2], [5], [7]])}, [3])
        assert choose(Alternating(), VALUES.expand(3, 4), root, ("a", "count")).tolist() == [2, 1, 3]
        assert root["next", "a", "count"].tolist() == [[3], [6], [8]]

    def test_where_no_choice_is_due_it_stays(self):
        root = TensorDict({"count": torch.tensor([[2], [5], [7]])}, [3])
        choose(Alternating(), VALUES.expand(3, 4), root, "count", due=torch.tensor([True, False, True]))
        assert root["next", "count"].tolist() == [[3], [5], [8]]

    def test_an_exploration_that_carries_nothing_reads_and_writes_nothing(self):
        root = TensorDict({}, [3])
        assert choose(EpsilonGreedy(0.0, 0.0), VALUES.expand(3, 4), root, "count").tolist() == [1, 1, 1]
        assert root.is_empty()


def test_a_level_between_may_explore_by_the_success_of_what_it_pursues():
    env = MultiGoalGridEnv(num_envs=8, layout="nine_rooms", seed=0, max_steps=30)
    agent = algorithms.make_v3(env, compact_network(), levels=3, middle_exploration=SuccessEpsilonGreedy())
    between, goals = agent.explorations["rooms"], len(env.task.subgoals[-1])
    steps = agent.transform(env).rollout(60, agent.policy, break_when_any_done=False)
    between.observe(steps)
    ended = steps["next", "active_subgoal"][steps["next", "option_done"].squeeze(-1)]
    assert torch.equal(between.success.options, ended.bincount(minlength=goals)) and len(ended)


@pytest.mark.parametrize("level", ["sub", "meta"])
@pytest.mark.parametrize("builder", ["make_hdrqn", "make_v3"])
def test_an_exploration_of_ones_own_works_at_every_level(builder, level):
    env = MultiGoalGridEnv(num_envs=4, seed=0, max_steps=40)
    agent = getattr(algorithms, builder)(
        env, compact_network(), max_option_steps=7, **{f"{level}_exploration": Alternating()}
    )
    steps = agent.transform(env).rollout(100, agent.policy, break_when_any_done=False)
    chosen = steps["action" if level == "sub" else "subgoal"]
    carried = steps["repeated_action" if level == "sub" else "subgoal_exploration"].squeeze(-1)
    due = torch.ones_like(steps["is_init"]) if level == "sub" else steps["option_init"]
    due, size = due.squeeze(-1), 4 if level == "sub" else 2
    assert (chosen == carried % size)[due].all()
    before, after = carried[:, :-1], carried[:, 1:]
    fresh = steps["is_init"][:, 1:].squeeze(-1)
    assert (after == torch.where(fresh, 0, before + due[:, :-1])).all() and carried.max() > 1


class Returning(EpsilonGreedy):
    """Returns what it is told to, whatever it is asked."""

    carried_spec = Unbounded(shape=(1,), dtype=torch.int64)

    def __init__(self, returned):
        super().__init__()
        self.returned = returned

    def forward(self, values, *, mask=None, condition=None, starts=None, carried=None):
        return self.returned


CHOICE, KEPT = torch.zeros(3, dtype=torch.int64), torch.zeros(3, 1, dtype=torch.int64)


@pytest.mark.parametrize(
    ("returned", "message"),
    [
        (CHOICE, r"must return a choice and what to carry, got Tensor; return \(choice, None\)"),
        ((CHOICE.float(), KEPT), r"must return a choice, \[3\] torch.int64, got \[3\] torch.float32; an index"),
        ((KEPT, KEPT), r"must return a choice, \[3\] torch.int64, got \[3, 1\] torch.int64; an index"),
        ((CHOICE, None), r"must return what to carry, \[3, 1\] torch.int64, got None; as carried_spec has it"),
        ((CHOICE, CHOICE), r"must return what to carry, \[3, 1\] torch.int64, got \[3\] torch.int64; as carried_spec"),
    ],
    ids=["choice alone", "number", "column", "nothing carried", "carried shape"],
)
def test_an_exploration_that_returns_something_else_is_named_with_what_it_must_return(returned, message):
    with pytest.raises(ValueError, match=f"Returning.forward {message}"):
        choose(Returning(returned), torch.rand(3, 4), TensorDict({"kept": KEPT}, [3]), "kept")
