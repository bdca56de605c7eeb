from functools import partial
from itertools import islice
from types import SimpleNamespace

import pytest
import torch
from helpers import ALGORITHMS, build, house, make_collector, small_env
from tape import Tape
from torchrl.envs import TransformedEnv
from torchrl.envs.transforms import RewardSum
from torchrl.envs.utils import ExplorationType, set_exploration_type

from hdrqn_torchrl.data import Continuity
from hdrqn_torchrl.envs.grid.rules import GridRules, GridState
from hdrqn_torchrl.modules import RepeatingEpsilonGreedy
from hdrqn_torchrl.runs.collectors import making as collecting
from hdrqn_torchrl.runs.collectors.captured import CapturedCollector, can_capture
from hdrqn_torchrl.runs.collectors.resumable import ResumableCollector

EVERY = [(name, 2) for name in ALGORITHMS] + [("v2", 3), ("v3", 1), ("v3", 2), ("v3", 3)]
IDS = [f"{name}-{levels}" for name, levels in EVERY]
NEVER = 10**9  # recorded


def make(name, levels=2, num_envs=6):
    """An algorithm and worlds in which options, episodes and obstacles end at different steps."""
    torch.manual_seed(0)
    worlds = house if levels == 3 else small_env
    env = worlds(num_envs, max_steps=5, obstacle="teleport")
    options = {} if name in ("dqn", "drqn") else {"max_option_steps": 2}
    if name == "v3":
        options["sub_exploration"] = RepeatingEpsilonGreedy()
    if name in ("v1", "v2", "v3"):
        options["levels"] = levels
    return build(name, env, **options), env


def make_captured(algorithm, env, steps=4, **options):
    settings = {"recording": Tape, "warm_ups": 1} | options
    return CapturedCollector(
        algorithm.transform(env), algorithm.policy, frames_per_batch=env.batch_size[0] * steps, **settings
    )


def take(collector, number):
    return [batch.clone() for batch in islice(collector, number)]


def check_equal(found, expected):
    for one, other in zip(found, expected, strict=True):
        assert set(one.keys(True, True)) == set(other.keys(True, True))
        assert [key for key, value in one.items(True, True) if not torch.equal(value, other[key])] == []
        assert {key: each.dtype for key, each in one.items(True, True)} == {
            key: each.dtype for key, each in other.items(True, True)
        }


@pytest.mark.parametrize(("name", "levels"), EVERY, ids=IDS)
class TestBatches:
    def test_replayed_batches_equal_those_that_are_not_captured(self, name, levels, as_on_gpu):
        """The host reads nothing; random numbers go on; epsilon falls in between."""
        results = []
        for warm_ups in (1, NEVER):
            algorithm, env = make(name, levels)
            collector = make_captured(algorithm, env, warm_ups=warm_ups)
            torch.manual_seed(5)
            batches = []
            for batch in islice(collector, 6):
                batches.append(batch.clone())
                for exploration in algorithm.explorations.values():
                    exploration.step(20_000)
            results.append(batches)
        check_equal(*results)
        assert any(batch["next", "done"].any() for batch in results[0][2:])

    def test_they_equal_those_of_torchrls_collector(self, name, levels, as_on_gpu, monkeypatch):
        """Where new worlds are the same, whoever draws them: TorchRL draws none while no episode ends."""
        fixed = GridState(*(part.clone() for part in make(name, levels)[1].state))
        monkeypatch.setattr(
            GridRules, "sample", lambda rules, number, _: GridState(*(part[:number].clone() for part in fixed))
        )
        results = []
        for kind in ("own", "torchrl"):
            algorithm, env = make(name, levels)
            collector = (
                make_captured(algorithm, env)
                if kind == "own"
                else make_collector(algorithm, env, 4, kind=ResumableCollector)
            )
            torch.manual_seed(5)
            results.append(take(collector, 6))
        check_equal(*results)
        assert sum(batch["next", "done"].sum() for batch in results[0]) > 12

    def test_learners_can_store_them(self, name, levels, as_on_gpu):
        algorithm, env = make(name, levels)
        continuity = Continuity()
        for batch in take(make_captured(algorithm, env), 5):
            continuity.check(batch)
            algorithm.observe(batch)
        assert all(len(learner.buffer) for learner in algorithm.learners.values())


class TestState:
    def test_a_restored_collector_goes_on_in_mid_episode(self, as_on_gpu):
        algorithm, env = make("v3")
        collector = make_captured(algorithm, env)
        take(collector, 3)
        state = collector.state_dict()
        torch.manual_seed(5)
        expected = take(collector, 3)
        other = make_captured(algorithm, small_env(6, max_steps=5, obstacle="teleport", seed=9))
        take(other, 4)
        other.load_state_dict(state)
        torch.manual_seed(5)
        check_equal(take(other, 3), expected)

    @pytest.mark.parametrize("first", ["own", "torchrl"])
    def test_the_state_of_torchrls_collector_will_do_and_vice_versa(self, first, as_on_gpu):
        algorithm, env = make("v3")
        makers = [make_captured, lambda *each: make_collector(*each, 4, kind=ResumableCollector)]
        makers = makers if first == "own" else makers[::-1]
        collector = makers[0](algorithm, env)
        last = take(collector, 3)[-1]
        state = collector.state_dict()
        other = makers[1](algorithm, small_env(6, max_steps=5, obstacle="teleport", seed=9))
        other.load_state_dict(state)
        continuity = Continuity()
        for batch in (last, *take(other, 3)):
            continuity.check(batch)

    @pytest.mark.parametrize("again", [False, True], ids=["the same", "another"])
    def test_after_an_error_new_episodes_begin_in_all_rows(self, as_on_gpu, again):
        algorithm, env = make("v3")
        collector = make_captured(algorithm, env)
        continuity = Continuity()
        continuity.check(take(collector, 3)[-1])
        collector.give_up(48)
        state = collector.state_dict()
        if again:
            collector = make_captured(algorithm, small_env(6, max_steps=5, obstacle="teleport", seed=9))
            collector.load_state_dict(state)
        first, second = take(collector, 2)
        for batch in (first, second):
            continuity.check(batch)
        assert first["is_init"][:, 0].all() and not second["is_init"][:, 0].all()
        assert state["frames"] == 48 and "carrier" in collector.state_dict()

    def test_the_number_of_batches_is_that_of_all_frames(self, as_on_gpu):
        algorithm, env = make("drqn")
        assert len(list(make_captured(algorithm, env, total_frames=72))) == 3


def test_a_run_collects_so_where_it_captures(as_on_gpu, monkeypatch):
    monkeypatch.setattr(collecting, "wants_capture", lambda capture, device: capture is True)
    monkeypatch.setattr(collecting, "CapturedCollector", partial(CapturedCollector, recording=Tape))
    algorithm, env = make("v2")
    settings = SimpleNamespace(
        capture=True, collector=SimpleNamespace(kind="local"), steps_per_batch=4, total_frames=48
    )
    collector = collecting.make_collector(settings, env, algorithm, device="cpu")
    assert isinstance(collector, CapturedCollector) and [batch.shape for batch in collector] == [(6, 4)] * 2
    settings.capture = False
    assert isinstance(collecting.make_collector(settings, env, algorithm, device="cpu"), ResumableCollector)


def test_only_known_tensor_programs_are_captured():
    algorithm, env = make("v2")
    transformed = algorithm.transform(env)
    assert can_capture(transformed) and not can_capture(env)
    assert not can_capture(TransformedEnv(transformed, RewardSum()))


COMPILED = [
    pytest.param(*each, id=id, marks=[pytest.mark.slow] if id not in ("drqn-2", "v2-2", "v3-2") else [])
    for each, id in zip(EVERY, IDS, strict=True)
]


@pytest.mark.parametrize(("name", "levels"), COMPILED)
def test_a_step_of_acting_depends_on_no_value(name, levels, as_on_gpu):
    """So says the compiler, which refuses what the host would have to look into: policy, worlds, transforms."""
    algorithm, worlds = make(name, levels)
    worlds._generator = None  # torch's own: the compiler knows no other
    env = algorithm.transform(worlds)

    def act(root):
        return env.step(algorithm.policy(root))

    roots = [env.reset()]
    for _ in range(2):
        roots.append(env.step_mdp(act(roots[-1].clone())))
    torch.compiler.reset()
    compiled = torch.compile(act, fullgraph=True, backend="eager", dynamic=False)
    with set_exploration_type(ExplorationType.RANDOM), torch.no_grad():
        for root, stance in zip(roots[1:], ("default", "fail_on_recompile"), strict=True):
            before, results = worlds.worlds, []
            for work in (act, compiled):
                worlds.worlds = before
                torch.manual_seed(5)
                with torch._dynamo.config.patch(allow_rnn=True), torch.compiler.set_stance(stance):
                    results.append(work(root.clone()))
            check_equal(results[:1], results[1:])
