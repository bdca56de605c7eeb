"""Checks for GPUs that run on a CPU: operations that would make the host wait, and tensors on the wrong device."""

import pytest
import torch
from elsewhere import elsewhere
from helpers import ALGORITHMS, build, collect, make_training, small_env, subgoal_env, tiny_settings
from tensordict import TensorDict
from torchrl.envs import ExplorationType, set_exploration_type
from waits import HostWaits

from hdrqn_torchrl.envs import MontezumaEnv
from hdrqn_torchrl.envs.grid.rules import GridState
from hdrqn_torchrl.learning import learner as learner_module
from hdrqn_torchrl.learning.legs import LegCounter
from hdrqn_torchrl.modules import EpsilonGreedy, RepeatingEpsilonGreedy, compact_network, paper_network
from hdrqn_torchrl.runs.evaluation import evaluate
from hdrqn_torchrl.transforms.window import resized

EVERY = (*ALGORITHMS, "v3")
FLAT = ("dqn", "drqn")
ARRIVED = "devices.py:truth"  # what a GPU has copied to the host
DRAWN_BY_THE_HOST = "_local_scalar_dense objectives/prediction.py:draw_ahead"  # a number of its own generator


def make(name, env=None, **options):
    """An algorithm with options that end in mid-episode; its learners do not look at every update."""
    env = env or small_env(8, max_steps=5, obstacle="teleport")
    parts = {} if name in FLAT else {"max_option_steps": 2}
    if name == "v3":
        parts["sub_exploration"] = RepeatingEpsilonGreedy()
    algorithm = build(name, env, settings=tiny_settings(max_grad_norm=1.0), **(parts | options))
    for learner in algorithm.learners.values():
        learner.guard.at_once = False
    return algorithm, env


class TestFindWaits:
    x, mask = torch.arange(4.0), torch.tensor([True, False, True, False])

    @pytest.mark.parametrize(
        "wait",
        [
            lambda x, mask: x.sum().item(),
            lambda x, mask: bool(mask.any()),
            lambda x, mask: int(x[2]),
            lambda x, mask: x.tolist(),
            lambda x, mask: x.cpu(),
            lambda x, mask: x.numpy(),
            lambda x, mask: mask.nonzero(),
            lambda x, mask: x[mask],
            lambda x, mask: x.masked_select(mask),
            lambda x, mask: x.clone().__setitem__(mask, torch.ones(2)),
            lambda x, mask: x.unique(),
            lambda x, mask: torch.equal(x, x),
            lambda x, mask: x.repeat_interleave(x.long()),
            lambda x, mask: torch.tensor([1.0]),
            lambda x, mask: torch.as_tensor(0.5),
            lambda x, mask: torch.multinomial(x, 2),
            lambda x, mask: x.to("meta"),
            lambda x, mask: TensorDict(x=x, batch_size=4)[mask],
        ],
    )
    def test_operations_that_wait_for_a_device_are_found(self, wait):
        with HostWaits() as waits:
            wait(self.x, self.mask)
        assert waits.found

    @pytest.mark.parametrize(
        "work",
        [
            lambda x, mask: torch.where(mask, x, 0.0).sum(),
            lambda x, mask: x.clone().__setitem__(mask, 3.0),  # a masked_fill
            lambda x, mask: x.clone().__setitem__(slice(2), 3.0),
            lambda x, mask: x[x.long()],
            lambda x, mask: x.repeat_interleave(2),
            lambda x, mask: x.repeat_interleave(x.long(), output_size=6),
            lambda x, mask: torch.multinomial(x, 4, replacement=True),
            lambda x, mask: torch.full((2,), 0.5),
            lambda x, mask: torch.as_tensor(x),
            lambda x, mask: x.to(torch.float64),
            lambda x, mask: x.argsort(),
        ],
    )
    def test_operations_that_do_not_wait_are_not_reported(self, work):
        with HostWaits() as waits:
            work(self.x, self.mask)
        assert waits.found == []

    def test_the_place_in_the_package_is_reported(self):
        algorithm, env = make("drqn")
        learner = algorithm.learners["flat"]
        batch = collect(algorithm, env, 8)[0]
        with HostWaits() as waits:
            learner.store(batch)
        assert "_local_scalar_dense data/samplers.py:_find" in waits.found


class TestNothingWaits:
    @pytest.mark.parametrize("name", EVERY)
    def test_a_step_of_acting_waits_for_nothing(self, name, as_on_gpu):
        """Decision, worlds and option book. (TorchRL's own check for the end of episodes is not part of this.)"""
        algorithm, env = make(name)
        transformed = algorithm.transform(env)
        td = transformed.reset()
        for _ in range(7):
            with HostWaits() as waits, set_exploration_type(ExplorationType.RANDOM):
                td = transformed.step(algorithm.policy(td))
            assert waits.found == []
            ended = td["next", "done"].squeeze(-1)
            td = transformed.step_mdp(td)
            with HostWaits() as waits:
                env._renew(ended)
            assert waits.found == []

    @pytest.mark.parametrize("precision", ["fp32", "bf16"])
    @pytest.mark.parametrize("name", EVERY)
    def test_an_update_waits_for_nothing(self, name, precision, as_on_gpu):
        algorithm, env = make(name)
        batch = collect(algorithm, env, 10)[0]
        for learner in algorithm.learners.values():
            learner.precision = precision
            learner.store(batch)
            learner.learn()
            samples = [learner.sample() for _ in range(2)]
            with HostWaits() as waits:
                for sample in samples:
                    learner.update(sample)
            assert set(waits.found) <= {DRAWN_BY_THE_HOST} and learner.updates == 3

    def test_the_papers_network_waits_for_nothing(self, as_on_gpu):
        env = small_env(2)
        algorithm = build("v2", env, paper_network(8), settings=tiny_settings(slice_len=2))
        batch = collect(algorithm, env, 8)[0]
        for learner in algorithm.learners.values():
            learner.guard.at_once = False
            learner.store(batch)
            sample = learner.sample()
            with HostWaits() as waits:
                learner.update(sample)
            assert waits.found == []


@pytest.mark.parametrize("name", EVERY)
def test_operations_that_wait_do_so_once_per_batch(name, as_on_gpu, tmp_path):
    """The number does not grow with the number of updates or draws, and the places are known."""
    found = []
    for updates in (2, 20):  # of one draw and of three
        trainer = make_training(tmp_path / str(updates), name, log_frames=10**9, evaluation_frames=10**9)
        batches = iter(trainer.collector)
        for learner in trainer.algorithm.learners.values():
            learner.guard.at_once = False
        for _ in range(3):
            trainer.step(next(batches))
        batch, before = next(batches), trainer.updates
        for learner in trainer.algorithm.learners.values():
            learner.updates_due = lambda number=updates: number
        with HostWaits() as waits:
            trainer.step(batch)
        assert trainer.updates == before + updates * len(trainer.algorithm.learners)
        found.append(sorted(wait for wait in waits.found if wait != DRAWN_BY_THE_HOST))
        trainer.collector.shutdown()
    assert found[0] == found[1]
    expected = {
        ARRIVED,
        "runs/incoming.py:_arrived",
    }
    expected |= {"data/samplers.py:_find_starts" if name == "v3" else "data/samplers.py:_find"}
    if name in ("hdqn", "v1", "v2"):
        expected |= {"data/options.py:_pair", "data/options.py:_release"}
    assert {wait.split()[1] for wait in found[0]} == expected


class TestHostAndDevicePathsAgree:
    """The paths that avoid waiting for a GPU give the same results."""

    @pytest.mark.parametrize("precision", ["fp32", "bf16"])
    @pytest.mark.parametrize("name", EVERY)
    def test_updates_of_both_paths_agree(self, name, precision, request):
        losses = []
        for gpu in (False, True):
            torch.manual_seed(0)
            algorithm, env = make(name)
            batch = collect(algorithm, env, 10)[0]
            if gpu:
                request.getfixturevalue("as_on_gpu")
            for learner in algorithm.learners.values():
                learner.precision = precision
                learner.store(batch)
                losses += [learner.learn()["loss"].item() for _ in range(4)]
        half = len(losses) // 2
        exact = {"rel": 1e-5} if precision == "fp32" else {"rel": 3e-2, "abs": 1e-3}
        assert losses[:half] == pytest.approx(losses[half:], **exact) and half == 4 * len(algorithm.learners)

    def test_only_worlds_whose_episode_ended_are_reset(self, as_on_gpu):
        env = small_env(300, max_steps=9)
        env.steps += 3
        before, ended = env.state, torch.arange(300) % 3 == 0
        env._renew(ended)
        for old, new in zip(before, env.state, strict=True):
            assert (old == new)[~ended].all()
        assert env.steps.tolist() == [0 if each else 3 for each in ended.tolist()]
        new = torch.cat([env.state.agent[ended, None], env.state.objects[ended]], -1)
        assert (new.sort(-1).values.diff(dim=-1) > 0).all()  # nothing shares a cell
        assert (new != torch.cat([before.agent[ended, None], before.objects[ended]], -1)).any(-1).float().mean() > 0.9

    def test_only_the_obstacle_that_was_hit_moves_to_a_free_cell(self, as_on_gpu):
        env = small_env(64, obstacle="teleport", num_obstacles=2)
        hits = 0
        for _ in range(20):
            before = env.state
            env.step(env.rand_action(TensorDict(batch_size=64)))
            moved = env.state.objects[:, :2] != before.objects[:, :2]
            hit = before.objects[:, :2] == env.state.agent[:, None]
            assert (moved == hit).all()
            hits += hit.sum()
            places = torch.cat([env.state.agent[:, None], env.state.objects], -1)
            places = places.masked_fill(places == env.rules.nowhere, -1).sort(-1).values
            assert ((places.diff(dim=-1) > 0) | (places[:, 1:] == -1)).all()
            assert not env.rules.is_wall[places.clamp(min=0)][places >= 0].any()
        assert hits > 20


class TestEverythingIsOnOneDevice:
    """On the meta device, reading a number or mixing devices is an error."""

    @pytest.fixture
    def env(self, as_on_gpu):
        """Its worlds are on the meta device; networks and memories for it are made there."""
        env = small_env(8, max_steps=5, obstacle="teleport")
        env.__dict__["_device"], env._generator = torch.device("meta"), None
        for name, value in vars(env.rules).items():
            if isinstance(value, torch.Tensor):
                setattr(env.rules, name, value.to("meta"))
        env.state, env.steps = GridState(*(part.to("meta") for part in env.state)), env.steps.to("meta")
        return env

    @pytest.fixture
    def simple_learner(self, monkeypatch):
        """The meta device has no fused Adam, and TorchRL compares addresses."""
        monkeypatch.setattr(torch.optim, "Adam", lambda parameters, **_: torch.optim.SGD(parameters))
        monkeypatch.setattr(learner_module, "SoftTargetUpdate", lambda *_, **__: None)

    @staticmethod
    def devices(td):
        return {value.device.type for value in td.values(True, True)}

    def test_all_entries_of_the_worlds_are_on_the_device(self, env):
        after = env._step(TensorDict(action=torch.zeros(8, dtype=torch.int64, device="meta"), batch_size=8))
        env._renew(after["done"].squeeze(-1))
        assert self.devices(after) == {part.device.type for part in (*env.state, env.steps)} == {"meta"}
        assert self.devices(env._reset(None)) == {"meta"}

    def test_all_entries_of_the_option_book_are_on_the_device(self):
        env = subgoal_env(8, wrong_subgoal_reward=-0.5, max_option_steps=3)
        td = env.rand_action(env.reset()).to("meta")
        after = env.transform[1]._step(td, env.step(env.rand_action(env.reset()))["next"].to("meta"))
        assert self.devices(after) == {"meta"}
        book = env.transform[1]._fresh_book(torch.Size([8]), torch.device("meta"))
        assert {value.device.type for value in book.values()} == {"meta"}

    @pytest.mark.parametrize("network", [compact_network(8, (8,)), paper_network(8)], ids=["compact", "paper"])
    @pytest.mark.parametrize("name", EVERY)
    def test_all_entries_of_policy_and_loss_are_on_the_device(self, name, network, env, simple_learner):
        ladder = EpsilonGreedy(ladder=1.0)
        parts = {"exploration": ladder} if name in FLAT else {"meta_exploration": ladder}
        (real, real_env), (algorithm, _) = make(name), make(name, env, architecture=network, **parts)
        root = real.transform(real_env).reset().to("meta")
        with set_exploration_type(ExplorationType.RANDOM):
            assert self.devices(algorithm.policy(root)) == {"meta"}
        batch = collect(real, real_env, 10)[0]
        for level, learner in algorithm.learners.items():
            real.learners[level].store(batch)
            result = learner.loss(real.learners[level].sample().to("meta"))
            result["loss"].backward()
            assert self.devices(result) == {"meta"}
            norm = learner._step.watch_gradients(result["loss"])
            assert norm.device.type == learner.optimizer.found_inf.device.type == "meta"


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
class TestOnAGPU:
    def test_a_window_equals_that_of_a_cpu(self):
        for shape, size in (((16, 70, 70, 3), 44), ((2, 210, 160, 3), 44), ((3, 30, 33, 1), 84)):
            screens = torch.randint(256, shape, dtype=torch.uint8)
            assert torch.equal(resized(screens.cuda(), size).cpu(), resized(screens, size))

    @pytest.mark.parametrize("kind", [ExplorationType.RANDOM, ExplorationType.DETERMINISTIC])
    def test_an_evaluation_leaves_random_numbers_of_the_gpu_alone(self, kind):
        env = small_env(8, device="cuda")
        algorithm = build("v3", env)
        torch.cuda.manual_seed(5)
        state = torch.cuda.get_rng_state()
        results = [
            evaluate(algorithm.transform(env), algorithm.policy, episodes=8, exploration_type=kind) for _ in "ab"
        ]
        assert torch.equal(torch.cuda.get_rng_state(), state) and results[0] == results[1]

    @pytest.mark.parametrize("name", EVERY)
    def test_a_training_on_a_gpu_runs(self, name):
        algorithm, env = make(name, small_env(8, max_steps=5, obstacle="teleport", device="cuda"))
        for batch in collect(algorithm, env, 10, batches=2):
            for learner in algorithm.learners.values():
                learner.store(batch)
                assert learner.learn()["loss"].isfinite()


class TestStateOnTheHost:
    """Checkpoints are loaded with all tensors on the GPU; parts that work on the host move theirs back."""

    def test_the_stand_in_behaves_like_a_gpu_tensor(self):
        there = elsewhere({"a": [torch.arange(3)]})["a"][0]
        with pytest.raises(TypeError, match="to numpy"):
            there.numpy()
        with pytest.raises(RuntimeError, match="on the same device"):
            there + torch.arange(3)
        assert (there + 1).cpu().numpy().tolist() == [1, 2, 3]

    def test_legs_can_be_restored(self):
        algorithm, env = make("v2")
        batches = collect(algorithm, env, 6, batches=2)
        legs, other = LegCounter(2), LegCounter(2)
        legs.observe(batches[0])
        other.load_state_dict(elsewhere(legs.state_dict()))
        for each in (legs, other):
            each.observe(batches[1])
        assert torch.equal(other.options, legs.options) and legs.options.sum() > 20

    def test_priorities_can_be_restored(self):
        env = small_env(8)
        algorithm = build("drqn", env, settings=tiny_settings(priority_exponent=0.9))
        learner = algorithm.learners["flat"]
        learner.store(collect(algorithm, env, 10)[0])
        learner.learn()
        sampler = learner.buffer._sampler
        state = sampler.state_dict()
        sampler.load_state_dict(elsewhere(state))
        for name in ("priorities", "starts"):
            assert torch.equal(sampler.state_dict()[name], state[name])
        learner.learn()

    def test_emulators_can_be_restored(self):
        pytest.importorskip("ale_py")
        env, other = (MontezumaEnv(2, seed=seed, practice=0.5) for seed in (0, 1))
        env.rollout(3)
        other.load_state_dict(elsewhere(env.state_dict()))
        actions = [TensorDict(action=torch.tensor([3, 4]), batch_size=2) for _ in range(3)]
        assert all((env.step(td.clone()) == other.step(td.clone())).all() for td in actions)
