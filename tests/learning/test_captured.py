from copy import deepcopy
from functools import partial

import pytest
import torch
from helpers import ALGORITHMS, build, collect, house, small_env, tiny_settings
from tape import Tape
from tensordict import TensorDict

from hdrqn_torchrl.learning import Learner
from hdrqn_torchrl.learning import learner as learner_module
from hdrqn_torchrl.learning.captured import Captured, wants_capture
from hdrqn_torchrl.modules import RepeatingEpsilonGreedy

EVERY = [(name, 2) for name in ALGORITHMS] + [("v2", 3), ("v3", 1), ("v3", 2), ("v3", 3)]
IDS = [f"{name}-{levels}" for name, levels in EVERY]


def make_learners(name: str, levels: int, **settings) -> dict[str, Learner]:
    """Learners of an algorithm whose memories hold some episodes."""
    torch.manual_seed(0)
    env = house(8, max_steps=5, obstacle="teleport") if levels == 3 else small_env(8, max_steps=5, obstacle="teleport")
    options = {} if name in ("dqn", "drqn") else {"max_option_steps": 2}
    if name == "v3":
        options["sub_exploration"] = RepeatingEpsilonGreedy()
    if name not in ("dqn", "drqn", "hdqn"):
        options["levels"] = levels
    defaults = {"max_grad_norm": 1.0, "learning_rate": 1e-2, "learning_rate_end": 1e-3, "learning_rate_frames": 500}
    algorithm = build(name, env, settings=tiny_settings(**(defaults | settings)), **options)
    batch = collect(algorithm, env, 10)[0]
    for learner in algorithm.learners.values():
        learner.guard.at_once = False
        learner.store(batch)
    return algorithm.learners


def with_hindsight() -> dict[str, Learner]:
    """v2's learners, whose sub level learns about every subgoal from each sequence."""
    torch.manual_seed(0)
    env = small_env(8, max_steps=5, obstacle="teleport")
    algorithm = build("v2", env, settings=tiny_settings(), max_option_steps=2, sub_hindsight=True, meta_hindsight=True)
    batch = collect(algorithm, env, 10)[0]
    for learner in algorithm.learners.values():
        learner.guard.at_once = False
        learner.store(batch)
    return algorithm.learners


def learn(learner: Learner, updates: int) -> list[dict[str, float]]:
    """Updates at a falling learning rate."""
    reports = []
    for _ in range(updates):
        learner.schedule.frames += 20
        learner.optimizer.set_learning_rate(learner.learning_rate)
        reports.append({name: value.item() for name, value in learner.learn().items()})
    return reports


@pytest.fixture
def capturing(monkeypatch, as_on_gpu):
    """Learners capture their updates, on a CPU."""
    monkeypatch.setattr(learner_module, "wants_capture", lambda *_: True)
    monkeypatch.setattr(learner_module, "Captured", partial(Captured, recording=Tape, warm_ups=2))


def assert_same_reports(captured, plain, *, updates):
    """Both learn with the same random numbers; the second one calls what the first one has recorded."""
    plain._captured = plain._gradient_step
    results = []
    for each in (captured, plain):
        torch.manual_seed(5)
        results.append(learn(each, updates))
    assert results[0] == results[1]


class TestCapturedUpdates:
    @pytest.mark.parametrize(("name", "levels"), EVERY, ids=IDS)
    def test_weights_and_reports_equal_those_of_updates_that_are_not_captured(self, name, levels, capturing):
        captured, plain = (make_learners(name, levels) for _ in "ab")
        for level, learner in captured.items():
            assert_same_reports(learner, plain[level], updates=14)
            states = [each.loss.state_dict() for each in (learner, plain[level])]
            assert all(torch.equal(states[0][key], states[1][key]) for key in states[1] if key != "__batch_size")
            assert any(piece._results for piece in learner._captured._pieces.values())

    @pytest.mark.parametrize("kind", ["priorities", "hindsight"])
    def test_draws_by_priority_and_with_hindsight_belong_to_the_graph(self, kind, capturing):
        make = partial(make_learners, "v2", 2, priority_exponent=0.9) if kind == "priorities" else with_hindsight
        captured, plain = (make() for _ in "ab")
        for level, learner in captured.items():
            assert_same_reports(learner, plain[level], updates=8)
            assert learner.replay._drawn == []
            states = [each.buffer.state_dict()["_sampler"] for each in (learner, plain[level])]
            if kind == "priorities":
                assert all(torch.equal(*(state[name] for state in states)) for name in ("priorities", "starts"))
                assert len(states[0]["priorities"].unique()) > 4

    def test_a_fault_is_reported_with_its_place_and_changes_no_weight(self, capturing):
        learner = make_learners("drqn", 2)["flat"]
        learn(learner, 4)
        before = {name: value.clone() for name, value in learner.network.named_parameters()}
        bad = learner.sample()
        bad["next", "reward"][:] = torch.nan
        learner.update(bad)
        learn(learner, 2)
        assert all(torch.equal(before[name], value) for name, value in learner.network.named_parameters())
        with pytest.raises(ArithmeticError, match=r"the loss became nan in update 5, frame \d+$"):
            learner.check_finite()

    def test_a_restored_learner_goes_on_as_the_one_that_was_saved(self, capturing):
        learner, other = (make_learners("v3", 2)["joint"] for _ in "ab")
        learn(learner, 12)
        learn(other, 20)
        other.load_state_dict(deepcopy(learner.state_dict()))
        results = []
        for each in (learner, other):
            torch.manual_seed(5)
            results.append(learn(each, 12))
        assert results[0] == results[1]

    def test_a_state_can_be_loaded_where_updates_are_not_captured_and_back(self, capturing, monkeypatch):
        captured = make_learners("drqn", 2)["flat"]
        learn(captured, 5)
        monkeypatch.setattr(learner_module, "wants_capture", lambda *_: False)
        plain = make_learners("drqn", 2)["flat"]
        plain.load_state_dict(deepcopy(captured.state_dict()))
        assert plain.optimizer.param_groups[0]["lr"] == pytest.approx(plain.learning_rate)
        assert not isinstance(plain.optimizer.param_groups[0]["lr"], torch.Tensor)
        learn(plain, 2)
        captured.load_state_dict(deepcopy(plain.state_dict()))
        assert captured.optimizer.param_groups[0]["lr"].item() == pytest.approx(captured.learning_rate)
        assert captured.optimizer.param_groups[0]["capturable"]
        learn(captured, 3)


class TestCaptured:
    def test_results_of_a_call_are_left_alone_by_later_ones(self):
        captured = Captured(lambda sample, _: {"twice": sample["x"] * 2}, recording=Tape, warm_ups=1)
        samples = [TensorDict(x=torch.full((2,), value)) for value in (1.0, 2.0, 3.0)]
        results = [captured(sample)["twice"] for sample in samples]
        assert [result.tolist() for result in results] == [[2.0, 2.0], [4.0, 4.0], [6.0, 6.0]]

    def test_what_the_host_decides_has_a_recording_of_its_own(self):
        captured = Captured(lambda sample, factor: {"y": sample["x"] * factor}, recording=Tape, warm_ups=0)
        sample = TensorDict(x=torch.ones(1))
        assert [captured(sample, factor)["y"].item() for factor in (2, 5, 2, 5)] == [2.0, 5.0, 2.0, 5.0]

    @pytest.mark.parametrize("other", [{"x": torch.ones(3)}, {"x": torch.ones(2, dtype=torch.int64)}])
    def test_a_minibatch_of_another_shape_or_dtype_is_a_fault(self, other):
        captured = Captured(lambda sample, _: {"y": sample["x"]}, recording=Tape)
        captured(TensorDict(x=torch.ones(2)))
        with pytest.raises(AssertionError, match="unlike in the first minibatch"):
            captured(TensorDict(other))

    def test_a_number_from_the_host_would_be_what_it_was_at_the_recording(self):
        """So the stand-in finds what a graph would get wrong."""
        numbers = iter(range(9))
        captured = Captured(lambda sample, _: {"y": sample["x"] + next(numbers)}, recording=Tape, warm_ups=1)
        found = [captured(TensorDict(x=torch.zeros(1)))["y"].item() for _ in range(4)]
        assert found == [0.0, 1.0, 1.0, 1.0]


class TestWantsCapture:
    def test_capture_needs_a_gpu(self):
        with pytest.raises(
            ValueError, match=r"capture must be 'auto' or False on cpu, got True; only a GPU has graphs"
        ):
            wants_capture(True, "cpu")
        with pytest.raises(ValueError, match="capture must be 'auto', True or False, got 'yes'"):
            wants_capture("yes", "cuda")
        env = small_env(2)
        with pytest.raises(ValueError, match="capture must be"):
            build("drqn", env, settings=tiny_settings(capture=True))

    def test_a_gpu_captures_unless_told_otherwise(self):
        assert [wants_capture(each, "cuda") for each in ("auto", True, False)] == [True, True, False]


COMPILED = [
    pytest.param(*each, id=id, marks=[pytest.mark.slow] if id not in ("hdqn-2", "v2-2", "v3-2") else [])
    for each, id in zip(EVERY, IDS, strict=True)
]


@pytest.mark.parametrize(("name", "levels"), COMPILED)
def test_a_loss_depends_on_no_value_of_its_minibatch(name, levels, as_on_gpu):
    """So says the compiler, which refuses a loss that the host would have to look into."""
    for learner in make_learners(name, levels, slice_len=2).values():
        samples = [learner.sample() for _ in range(2)]
        shapes = [{key: (value.shape, value.dtype) for key, value in each.items(True, True)} for each in samples]
        assert shapes[0] == shapes[1]
        learner.loss.ahead = learner._step.draw_ahead(samples[0].shape[1])
        torch.compiler.reset()
        compiled = torch.compile(learner.loss, fullgraph=True, backend="eager", dynamic=False)
        for sample, stance in zip(samples, ("default", "fail_on_recompile"), strict=True):
            expected = learner.loss(sample.clone())
            with torch._dynamo.config.patch(allow_rnn=True), torch.compiler.set_stance(stance):
                found = compiled(sample.clone())
            assert all(torch.equal(value, found[key]) for key, value in expected.items())
