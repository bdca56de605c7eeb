import warnings
from copy import deepcopy

import pytest
import torch
from helpers import build, collect, parameter_distance, small_env, tiny_settings
from tensordict import TensorDict

from hdrqn_torchrl.algorithms import make_recurrent_loss
from hdrqn_torchrl.learning import Learner, LearnerSettings
from hdrqn_torchrl.learning import learner as learner_module
from hdrqn_torchrl.learning.finite import NonFiniteError
from hdrqn_torchrl.modules import FullyConnectedFeatures, QNetwork, SubController, paper_network
from hdrqn_torchrl.objectives import RecurrentDQNLoss
from hdrqn_torchrl.runs.persistence.checkpoint import Checkpoints


def make_learner(
    *, extract=None, num_envs=2, samples_per_draw=8, separate=None, episode_len=None, gamma=0.99, **settings
):
    torch.manual_seed(0)
    network = QNetwork(FullyConnectedFeatures(3, (8,)), num_actions=2, hidden_size=6)
    controller = SubController(network, subgoal_key=None, init_key="is_init")
    keep = extract or (lambda batch: batch)
    settings = tiny_settings(**settings)
    return Learner(
        controller,
        settings,
        extract=keep,
        loss=make_recurrent_loss(controller, settings, gamma=gamma),
        num_envs=num_envs,
        episode_len=episode_len,
        samples_per_draw=samples_per_draw,
        separate=separate,
    )


def make_batch(num_envs=2, time=8):
    """Episodes of four steps."""
    shape = (num_envs, time)
    td = TensorDict(observation=torch.randn(*shape, 3), action=torch.randint(2, shape), batch_size=shape)
    td["is_init"] = (torch.arange(time) % 4 == 0).expand(shape).unsqueeze(-1).clone()
    td["collector", "traj_ids"] = torch.arange(time // 4).repeat_interleave(4) + 100 * torch.arange(num_envs)[:, None]
    done = (torch.arange(time) % 4 == 3).expand(shape).unsqueeze(-1).clone()
    td["next"] = TensorDict(reward=torch.randn(*shape, 1), batch_size=shape)
    td["next"].update({"done": done, "terminated": done.clone(), "truncated": torch.zeros_like(done)})
    return td


class TestUpdatesDue:
    @pytest.mark.parametrize(
        ("warmup", "frames_per_update", "batches", "due"),
        [
            (0, 16, 1, 1),  # a batch has 16 frames
            (0, 8, 1, 2),
            (0, 0.5, 1, 32),
            (0, 17, 1, 0),
            (0, 24, 3, 2),
            (16, 4, 1, 0),
            (15, 1, 1, 1),
            (17, 1, 1, 0),
            (20, 4, 2, 3),
            (1_000, 1, 2, 0),
        ],
    )
    def test_updates_due_are_frames_after_warmup_over_the_ratio(self, warmup, frames_per_update, batches, due):
        learner = make_learner(warmup_frames=warmup, frames_per_update=frames_per_update)
        for _ in range(batches):
            learner.store(make_batch())
        assert learner.updates_due() == due

    def test_updates_made_are_no_longer_due_and_fractions_add_up(self):
        learner, made = make_learner(frames_per_update=24), []
        for _ in range(6):
            learner.store(make_batch())
            made.append(learner.updates_due())
            for _ in range(made[-1]):
                learner.learn()
        assert made == [0, 1, 1, 0, 1, 1] and learner.updates == 4 and learner.frames == 96

    def test_updates_due_are_counted_from_the_first_transition(self):
        """Options come out with the first finished episode: updates missed until then are not made up for."""
        learner = make_learner(frames_per_update=16, extract=lambda batch: batch if learner.frames > 32 else None)
        due = []
        for _ in range(4):
            learner.store(make_batch())
            due.append(learner.updates_due())
        assert due == [0, 0, 1, 2]

    def test_no_updates_are_due_while_nothing_is_stored(self):
        learner = make_learner(extract=lambda batch: None)
        learner.store(make_batch())
        assert learner.frames == 16 and learner.updates_due() == 0


class TestWhatCanNotBeDrawnYet:
    """Sequences that begin where an episode does need a start that is followed by enough steps."""

    @pytest.mark.parametrize("priority_exponent", [None, 0.9])
    @pytest.mark.parametrize(
        ("slice_len", "due"), [(3, [0, 2, 2, 2]), (5, [0, 0, 2, 2]), (6, [0, 0, 0, 2])], ids=lambda value: f"{value}"
    )
    def test_no_updates_are_due_before_a_sequence_can_be_drawn(self, priority_exponent, slice_len, due):
        """Batches of two steps, updates after every four frames: two of each batch."""
        learner = make_learner(
            sampling="episode_starts", slice_len=slice_len, frames_per_update=2, priority_exponent=priority_exponent
        )
        steps, found = make_batch(time=8), []
        for start in range(0, 8, 2):
            learner.store(steps[:, start : start + 2])
            found.append(learner.updates_due())
            for _ in range(found[-1]):
                learner.learn()
        assert found == due

    def test_a_memory_that_loses_its_last_start_waits_with_one_warning_and_goes_on(self):
        """Episodes of eight steps in a memory of six for each environment: at times there is none of three."""
        learner = make_learner(sampling="whole_episodes", slice_len=2, frames_per_update=2, capacity=12)
        steps = make_batch(time=24)
        steps["is_init"] = (torch.arange(24) % 8 == 0).expand(2, 24).unsqueeze(-1).clone()
        steps["next", "done"] = (torch.arange(24) % 8 == 7).expand(2, 24).unsqueeze(-1).clone()
        steps["collector", "traj_ids"] = torch.arange(24) // 8 + 100 * torch.arange(2)[:, None]
        found = []
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            for start in range(24):
                learner.store(steps[:, start : start + 1])
                found.append(learner.updates_due())
                for _ in range(found[-1]):
                    learner.learn()
        assert found == [0 if time % 8 in (6, 7) else 1 for time in range(24)]
        said = [str(each.message) for each in caught if "capacity should be so large" in str(each.message)]
        assert len(said) == 1 and "a sequence of 3 transitions" in said[0] and "got 12; nothing is learned" in said[0]

    def test_a_capacity_that_an_episode_does_not_fit_in_is_refused_at_once(self):
        with pytest.raises(ValueError, match="capacity must hold an episode of 8 and slice_len=3 transitions and 1 b"):
            make_learner(sampling="episode_starts", slice_len=3, capacity=20, episode_len=8)
        make_learner(sampling="episode_starts", slice_len=3, capacity=22, episode_len=8)

    def test_a_level_that_was_held_does_not_make_up_for_updates(self):
        learner, found = make_learner(frames_per_update=8), []
        for held in (False, True, True, False, False):
            learner.held = held
            learner.store(make_batch())
            found.append(learner.updates_due())
            for _ in range(found[-1]):
                learner.learn()
        assert found == [2, 0, 0, 2, 2]


class TestEpisodesThatAreLongerThanASequence:
    def warnings_of(self, *, batch_len=4, **settings):
        learner, steps = make_learner(**settings), make_batch(time=24)
        steps["is_init"] = (torch.arange(24) % 8 == 0).expand(2, 24).unsqueeze(-1).clone()
        steps["next", "done"] = (torch.arange(24) % 8 == 7).expand(2, 24).unsqueeze(-1).clone()
        steps["collector", "traj_ids"] //= 2
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            for start in range(0, 24, batch_len):
                learner.store(steps[:, start : start + batch_len])
        return [str(each.message) for each in caught if "slice_len should cover" in str(each.message)]

    @pytest.mark.parametrize("sampling", ["episode_starts", "whole_episodes"])
    @pytest.mark.parametrize("batch_len", [1, 3, 24])
    def test_episodes_longer_than_a_sequence_give_one_warning(self, sampling, batch_len):
        (said,) = self.warnings_of(sampling=sampling, slice_len=7, batch_len=batch_len)
        assert f"with sampling={sampling!r}, got 7 where one has more transitions; the later ones are never" in said

    @pytest.mark.parametrize(
        "settings",
        [
            {"sampling": "episode_starts", "slice_len": 8},
            {"sampling": "whole_episodes", "slice_len": 8, "batch_len": 3},
            {"sampling": "steps", "slice_len": 2},
            {"sampling": "episodes", "slice_len": 2},
            {"sampling": "episode_starts", "slice_len": 8, "episode_len": 8},
        ],
        ids=str,
    )
    def test_no_warning_is_given_where_all_steps_are_shown(self, settings):
        assert self.warnings_of(**settings) == []


class TestUpdate:
    def test_updates_reduce_the_loss_on_a_fixed_sample(self):
        learner = make_learner(learning_rate=1e-2, tau=1e-6)
        learner.store(make_batch())
        sample = learner.sample()
        losses = [learner.update(sample.clone())["loss"].item() for _ in range(60)]
        assert losses[-1] < 0.3 * losses[0] and learner.updates == 60

    def test_an_update_moves_the_acting_network_and_the_target_follows_at_the_rate_tau(self):
        learner = make_learner(tau=0.25, max_grad_norm=None)
        learner.store(make_batch())
        before = learner.loss.value_network_params.data.clone()
        assert parameter_distance(before, learner.loss.target_value_network_params) == 0
        metrics = learner.learn()
        after, target = learner.loss.value_network_params.data, learner.loss.target_value_network_params.data
        assert parameter_distance(before, after) > 0
        assert parameter_distance(before * 0.75 + after * 0.25, target) < 1e-6
        assert not any(value.requires_grad for value in metrics.values())
        assert set(metrics) == {"loss", "td_error", "q_value", "target", "trained_steps"}

    def test_a_second_update_adds_no_old_gradient(self):
        learners = [make_learner(learning_rate=1e-2) for _ in range(2)]
        torch.manual_seed(1)
        first, second = make_batch(), make_batch()
        for learner in learners:
            learner.update(first)
        learners[1].optimizer.zero_grad()
        for learner in learners:
            learner.update(second)
        params = [learner.loss.value_network_params.data for learner in learners]
        assert parameter_distance(*params) == 0

    def test_gradients_are_clipped_to_the_norm(self):
        norms = []
        for max_grad_norm in (1e-3, 1e3):
            learner = make_learner(max_grad_norm=max_grad_norm)
            torch.manual_seed(1)
            metrics = learner.update(make_batch())
            gradients = [p.grad.flatten() for p in learner.network.parameters()]
            norms.append((metrics["grad_norm"].item(), torch.cat(gradients).norm().item()))
        (before, clipped), (same, whole) = norms
        assert (
            before == pytest.approx(same) and clipped == pytest.approx(1e-3, rel=1e-2) and whole == pytest.approx(same)
        )

    def test_an_update_moves_only_its_own_level(self):
        env = small_env(4)
        algorithm = build("v2", env)
        sub, meta = algorithm.learners["sub"], algorithm.learners["meta"]
        batch = collect(algorithm, env, 20)[0]
        before = meta.loss.value_network_params.data.clone()
        sub.store(batch)
        sub.update(sub.sample())
        assert parameter_distance(before, meta.loss.value_network_params.data) == 0


class TestLongerTargets:
    """Rewards are 1 and a network of zeros adds nothing, so a target is the number of rewards that it holds."""

    def rewards_held(self, *, sampling="steps", episode=60, num_batches=2, **settings):
        """Of each trained step: rewards of its target, and stored steps of its episode from there on."""
        learner = make_learner(num_envs=4, sampling=sampling, gamma=1.0, batch_size=64, **settings)
        steps = make_batch(num_envs=4, time=120)
        steps["is_init"] = (torch.arange(120) % episode == 0).expand(4, 120).unsqueeze(-1).clone()
        done = (torch.arange(120) % episode == episode - 1).expand(4, 120).unsqueeze(-1).clone()
        steps["next"].update({"done": done, "terminated": done.clone(), "reward": torch.ones(4, 120, 1)})
        steps["collector", "traj_ids"] = torch.arange(120) // episode + 100 * torch.arange(4)[:, None]
        left = episode - torch.arange(120) % episode
        steps["left"] = left.expand(4, 120).clone()
        steps["action"].zero_()
        learner.store(steps)
        with torch.no_grad():
            for parameters in (learner.loss.value_network_params, learner.loss.target_value_network_params):
                parameters.data.zero_()
        found = []
        for _ in range(num_batches):
            sample = learner.sample()
            for row in sample.split(1):
                result = learner.loss(row)
                if count := int(result["trained_steps"]):
                    found.append((result["target"].item() * count, count, row))
        return learner, found

    @pytest.mark.parametrize("sampling", ["steps", "episodes", "whole_episodes", "episode_starts"])
    @pytest.mark.parametrize(("n_step", "slice_len"), [(5, 8), (3, 1)])
    def test_every_target_holds_all_its_rewards(self, n_step, slice_len, sampling):
        learner, found = self.rewards_held(n_step=n_step, slice_len=slice_len, sampling=sampling)
        assert learner.sample().shape == (64, slice_len + n_step) and len(found) > 80
        burn_in = slice_len // 2
        for held, count, row in found:
            first = 0 if row["is_init"][0, 0] or slice_len == 1 else burn_in
            left = row["left"][0, first : first + count]
            if not row["is_init"][0, 1:].any():
                assert held == left.clamp(max=n_step).sum() and count <= slice_len

    @pytest.mark.parametrize("sampling", ["steps", "episodes"])
    def test_the_last_steps_of_an_episode_are_also_trained(self, sampling):
        _, found = self.rewards_held(n_step=5, slice_len=4, sampling=sampling, episode=20, num_batches=4)
        trained = torch.zeros(21)
        for _, count, row in found:
            first = 0 if row["is_init"][0, 0] else 2
            for left in row["left"][0, first : first + count].tolist():
                trained[left] += 1
        assert (trained[1:] > 0).all()

    def test_a_trace_reaches_beyond_the_sequence(self):
        learner, found = self.rewards_held(trace_decay=0.8, slice_len=8)
        assert learner.sample().shape == (64, 8 + 4 + 1)
        inner = [held / count for held, count, row in found if row["left"].min() > 1 and not row["is_init"].any()]
        weights = torch.tensor([0.8**step for step in range(8)])
        # Values are equal, so that action 0 is the greedy one: each target holds 5 rewards or more.
        assert min(inner) >= weights[:5].sum() - 1e-4 and learner.settings.lookahead() == 4

    def test_sequences_from_episode_starts_have_no_lookahead_for_a_trace(self):
        for sampling in ("episode_starts", "whole_episodes"):
            assert tiny_settings(trace_decay=0.8, sampling=sampling).lookahead() == 0
            assert tiny_settings(n_step=3, sampling=sampling).lookahead() == 2


class TestPriorities:
    def errors_of(self, learner, sample):
        with torch.no_grad():
            return learner.loss(sample)["priority"]

    def test_an_update_sets_only_the_priorities_of_its_minibatch(self):
        """As they were before its gradient step, at the first steps of its sequences."""
        learner = make_learner(priority_exponent=1.0, slice_len=2, batch_size=3, learning_rate=0.5)
        learner.store(make_batch())
        sample, other = learner.sample(), learner.sample()
        expected = self.errors_of(learner, sample)
        metrics = learner.update(sample)
        assert "priority" not in metrics and all(value.ndim == 0 for value in metrics.values())
        found = self.stored(learner, sample)
        torch.testing.assert_close(found, expected)
        starts = sample["index"][:, 0].tolist()
        others = [row for row, start in enumerate(other["index"][:, 0].tolist()) if start not in starts]
        assert others and (self.stored(learner, other)[others] == 1.0).all()
        assert learner.buffer.sampler.state_dict()["starts"].sum() == 16

    def stored(self, learner, sample):
        """Priorities that the memory has of the sequences of a sample."""
        time, env = sample["index"][:, 0].unbind(-1)
        return learner.buffer.sampler.state_dict()["priorities"][time * 2 + env] - 1e-3

    def test_learned_sequences_are_drawn_less_often(self):
        torch.manual_seed(0)
        learner = make_learner(priority_exponent=1.0, slice_len=4, batch_size=8, samples_per_draw=1)
        batch = make_batch(num_envs=2)
        batch["next", "reward"].zero_()
        batch["next", "reward"][0, :4] = 30.0  # what this episode pays can't be learned soon
        learner.store(batch)
        shown = torch.cat([self.learn(learner) for _ in range(40)][10:])
        assert (shown == 0).float().mean() > 0.8
        uniform = make_learner(slice_len=4, batch_size=8, samples_per_draw=1)
        uniform.store(batch)
        assert (torch.cat([self.learn(uniform) for _ in range(40)]) == 0).float().mean() < 0.4

    def learn(self, learner):
        sample = learner.sample()
        learner.update(sample)
        return sample["collector", "traj_ids"][:, 0]

    def test_importance_weights_reach_the_loss(self):
        losses = []
        for importance_exponent in (0.0, 1.0):
            learner = make_learner(
                priority_exponent=1.0, importance_exponent=importance_exponent, slice_len=4, batch_size=32
            )
            learner.store(make_batch())
            for _ in range(20):
                sample = learner.sample()
                metrics = learner.update(sample)
            losses.append((metrics["loss"] < learner.loss(sample.exclude("priority_weight"))["loss"]).item())
            assert (sample["priority_weight"] == 1.0).all() == (importance_exponent == 0.0)
        assert losses[1]

    def test_a_loss_that_reports_no_priority_is_refused(self):
        learner = make_learner()
        learner.loss.out_keys = ["loss"]
        with pytest.raises(ValueError, match="priority_exponent must be None for RecurrentDQNLoss, which reports no"):
            Learner(
                learner.network, tiny_settings(priority_exponent=0.9), extract=Keep(), loss=learner.loss, num_envs=2
            )


class TestLearningRate:
    def test_the_learning_rate_falls_linearly_and_then_stays(self):
        learner = make_learner(learning_rate=1e-2, learning_rate_end=2e-3, learning_rate_frames=64)
        rates = [learner.learning_rate]
        for _ in range(5):
            learner.store(make_batch())
            rates.append(learner.learning_rate)
            assert learner.optimizer.param_groups[0]["lr"] == learner.learning_rate
        assert rates == pytest.approx([1e-2, 8e-3, 6e-3, 4e-3, 2e-3, 2e-3])

    def test_the_learning_rate_is_constant_without_an_end(self):
        learner = make_learner(learning_rate=1e-2, learning_rate_end=None, learning_rate_frames=16)
        learner.store(make_batch())
        assert learner.learning_rate == learner.optimizer.param_groups[0]["lr"] == 1e-2


class TestSample:
    def test_one_draw_gives_several_minibatches_and_a_new_batch_discards_them(self):
        learner = make_learner(samples_per_draw=3, batch_size=5, slice_len=4)
        learner.store(make_batch())
        draws = count_draws(learner)
        for _ in range(3):
            assert learner.sample().shape == (5, 4 + 1)
        assert len(draws) == 1
        learner.sample()
        assert len(draws) == 2
        learner.store(make_batch())
        learner.sample()
        assert len(draws) == 3

    def test_minibatches_of_one_draw_differ(self):
        learner = make_learner(samples_per_draw=2, batch_size=16)
        learner.store(make_batch())
        first, second = learner.sample(), learner.sample()
        assert (first["observation"] != second["observation"]).any()

    @pytest.mark.parametrize("slice_len", [1, 4])
    def test_a_sample_has_the_shape_of_the_settings(self, slice_len):
        learner = make_learner(slice_len=slice_len, batch_size=7)
        learner.store(make_batch())
        assert learner.sample().shape == (7, slice_len + 1)


def count_draws(learner):
    draws, sample = [], learner.buffer.sample
    learner.buffer.sample = lambda *args: draws.append(1) or sample(*args)
    return draws


class TestSettings:
    @pytest.mark.parametrize(
        ("name", "value", "rule"),
        [
            ("slice_len", 0, ">= 1"),
            ("batch_size", 0, ">= 1"),
            ("capacity", 3, ">= slice_len"),
            ("frames_per_update", 0.0, "> 0"),
            ("warmup_frames", -1, ">= 0"),
            ("learning_rate", 0.0, "> 0"),
            ("learning_rate_end", 0.5, r"in \(0, learning_rate=0.001\] or None"),
            ("learning_rate_frames", 0, ">= 1"),
            ("tau", 0.0, r"in \(0, 1\]"),
            ("tau", 1.5, r"in \(0, 1\]"),
            ("max_grad_norm", 0.0, "> 0 or None"),
            ("priority_exponent", 0.0, r"in \(0, 1\] or None"),
            ("priority_exponent", 1.5, r"in \(0, 1\] or None"),
            ("importance_exponent", -0.1, r"in \[0, 1\]"),
            ("importance_exponent", 1.1, r"in \[0, 1\]"),
        ],
    )
    def test_wrong_values_are_refused_when_set(self, name, value, rule):
        with pytest.raises(ValueError, match=f"{name} must be {rule}, got {value}; "):
            tiny_settings(**{name: value})

    @pytest.mark.parametrize("sampling", ["episode_starts", "whole_episodes"])
    def test_stored_state_is_refused_where_the_state_is_zero(self, sampling):
        with pytest.raises(ValueError, match=f"stored_state must be False with sampling='{sampling}', got True; "):
            tiny_settings(sampling=sampling, stored_state=True)

    def test_settings_that_never_train_the_first_steps_are_refused(self):
        settings = {"sampling": "episode_starts", "train_exact_states": False}
        with pytest.raises(ValueError, match=r"with burn_in=0.5 and sampling='episode_starts', got False; "):
            tiny_settings(**settings)
        assert not tiny_settings(**settings, burn_in=0.0).train_exact_states

    @pytest.mark.parametrize(
        ("name", "value", "message"),
        [
            ("burn_in", 1.0, r"burn_in must be in \[0, 1\), got 1.0; "),
            ("loss_function", "l1", "loss_function must be 'l2' or 'smooth_l1', got 'l1'; "),
            ("precision", "fp16", "precision must be 'auto', 'fp32' or 'bf16', got 'fp16'; "),
            ("sampling", "rows", "sampling must be 'steps', 'episodes', .* or 'whole_episodes', got 'rows'; "),
        ],
    )
    def test_wrong_settings_of_memory_and_loss_are_refused(self, name, value, message):
        with pytest.raises(ValueError, match=message):
            make_learner(**{name: value})

    @pytest.mark.parametrize(
        "changes",
        [
            {"burn_in": 0.0},
            {"train_exact_states": False},
            {"loss_function": "smooth_l1"},
            {"double": False},
            {"learning_rate": 0.1},
            {"max_grad_norm": 1e-3},
            {"tau": 0.5},
            {"max_target": 0.1},
            {"trace_decay": 0.5},
            {"n_step": 2},
            {"precision": "bf16"},
        ],
        ids=str,
    )
    def test_each_setting_changes_what_is_learned(self, changes):
        """Four updates on the same data end in other parameters."""
        usual = {"learning_rate": 0.05, "batch_size": 8}
        default, changed = make_learner(**usual), make_learner(**(usual | changes))
        torch.manual_seed(1)
        samples = [make_batch(num_envs=8) for _ in range(4)]
        for sample in samples:
            sample["is_init"][:2] = False
            default.update(sample.clone())
            changed.update(sample.clone())
        params = [learner.loss.value_network_params.data for learner in (default, changed)]
        assert parameter_distance(*params) > 1e-7

    @pytest.mark.parametrize(
        ("changes", "message"),
        [
            ({"trace_decay": -0.1}, r"trace_decay must lie in \[0, 1\], got -0.1; "),
            ({"n_step": 0}, "n_step must be >= 1, got 0; "),
            ({"n_step": 3, "trace_decay": 0.5}, "n_step must be 1 where trace_decay > 0, got n_step=3 and .*=0.5; "),
            ({"trace_decay": 0.5, "slice_len": 1}, "slice_len must be > 1 where trace_decay > 0, got 1; "),
        ],
    )
    def test_contradictory_lengths_of_targets_are_refused(self, changes, message):
        with pytest.raises(ValueError, match=message):
            tiny_settings(**changes)

    def test_the_memory_uses_the_sampling_of_the_settings(self):
        samplers = {type(make_learner(sampling=kind).buffer.sampler) for kind in ("steps", "episodes")}
        assert len(samplers) == 2

    def test_settings_are_frozen(self):
        with pytest.raises(AttributeError):
            LearnerSettings().slice_len = 3


class Keep:
    """Stores batches as they are, from the second on, and counts them."""

    def __init__(self):
        self.batches = 0

    def __call__(self, batch):
        self.batches += 1
        return batch if self.batches > 1 else None

    def state_dict(self):
        return {"batches": self.batches}

    def load_state_dict(self, state):
        self.batches = state["batches"]


def stored_twice():
    learner = make_learner(extract=Keep())
    for _ in range(2):
        learner.store(make_batch())
    return learner


class TestState:
    @pytest.mark.parametrize("priority_exponent", [None, 0.9])
    def test_a_copy_of_a_learner_continues_alike(self, priority_exponent):
        """In the middle of the minibatches of one draw, after a first transition that came late."""
        settings = {
            "learning_rate": 0.05,
            "learning_rate_end": 1e-3,
            "learning_rate_frames": 200,
            "frames_per_update": 4,
            "priority_exponent": priority_exponent,
        }
        first, second = (make_learner(extract=Keep(), capacity=24, **settings) for _ in range(2))
        torch.manual_seed(1)
        batches = [make_batch() for _ in range(6)]
        for batch in batches[:3]:
            first.store(batch)
        for _ in range(3):
            first.update(first.sample())
        torch.manual_seed(7)
        second.store(make_batch())
        second.store(make_batch())
        second.update(second.sample())  # it has other weights and another optimiser
        second.load_state_dict(deepcopy(first.state_dict()))  # torch's optimiser keeps what it is given
        assert second.updates_due() == first.updates_due() == 5
        losses = []
        for learner in (first, second):
            torch.manual_seed(2)
            losses.append([])
            for batch in batches[3:]:
                for _ in range(learner.updates_due()):
                    losses[-1].append(learner.learn()["loss"].item())
                learner.store(batch)
        assert losses[0] == losses[1] and len(losses[0]) == 13
        for params in ("value_network_params", "target_value_network_params"):
            assert parameter_distance(*(getattr(learner.loss, params).data for learner in (first, second))) == 0
        assert first.optimizer.param_groups[0]["lr"] == second.optimizer.param_groups[0]["lr"] == second.learning_rate

    @pytest.mark.parametrize("name", ["updates", "frames", "warm_at"])
    @pytest.mark.parametrize("value", [-1, -(10**12), -1e12, 2**53, 0.5, float("nan"), None, "1"])
    def test_counters_that_no_training_has_are_refused(self, name, value):
        learner = stored_twice()
        state = deepcopy(learner.state_dict())
        state[name] = value
        with pytest.raises(ValueError, match=rf"learner's {name} must be a whole number in \[0, 2\*\*53\), got"):
            learner.load_state_dict(state)
        assert learner.updates_due() == 1

    def test_a_state_with_too_few_updates_is_refused(self):
        learner = stored_twice()
        state = deepcopy(learner.state_dict()) | {"frames": 10**12}
        with pytest.raises(ValueError, match="updates must make up for its frames, got 0 for 1000000000000"):
            learner.load_state_dict(state)


def test_a_network_with_convolutions_learns_on_as_if_it_had_not_been_saved(tmp_path):
    """Their weights have the channels last, and what a file holds has not: Adam's moments must follow the weights."""
    torch.manual_seed(0)
    first, second = (build("drqn", small_env(4), paper_network(8)).learners["flat"] for _ in range(2))
    (batch,) = collect(build("drqn", small_env(4), paper_network(8)), small_env(4), 16)
    first.store(batch)
    for _ in range(2):
        first.update(first.sample())
    path = Checkpoints(tmp_path).save({"learner": first}, step=1)
    Checkpoints(tmp_path).load({"learner": second}, path)
    sample = first.sample()
    for learner in (first, second):
        learner.update(sample.clone())
    for (name, one), (_, other) in zip(
        first.network.named_parameters(), second.network.named_parameters(), strict=True
    ):
        assert torch.equal(one, other), name
        assert first.optimizer.state[one]["exp_avg"].stride() == one.stride()
        assert second.optimizer.state[other]["exp_avg"].stride() == other.stride()


class TestShapes:
    def test_all_of_a_batch_is_stored_from_the_devices_of_the_learner(self):
        """TorchRL's Collector leaves the numbers of episodes on the host unless it is given a device."""
        learner, seen = make_learner(), []
        extract, learner.extract = learner.extract, lambda batch: extract(seen.append(batch.device) or batch)
        learner.store(make_batch())
        assert seen == [learner.device] and make_batch().device is None

    def test_a_batch_of_other_environments_is_refused(self):
        learner = make_learner(num_envs=2)
        learner.store(make_batch())
        for batch in (make_batch(num_envs=3), make_batch(num_envs=1)):
            with pytest.raises(ValueError, match="batch must hold the same 2 environments, got"):
                learner.store(batch)
            with pytest.raises(
                ValueError, match=r"transitions must have the shape \[2, T\] that this memory was built"
            ):
                make_learner(num_envs=2).store(batch)
        for batch in (make_batch()[0], make_batch().unsqueeze(0), make_batch().reshape(2, 2, 4)):
            with pytest.raises(ValueError, match=r"batch must be \[N, T\], N environments and T steps"):
                learner.store(batch)


class TestNumbersThatAreNone:
    def poisoned(self, **settings):
        learner = make_learner(**settings)
        learner.store(make_batch())
        learner.learn()
        return learner, learner.sample()

    def check_nothing_was_learned(self, learner, sample, message):
        everything = [*learner.loss.parameters(), *learner.loss.buffers()]
        before = [value.clone() for value in everything]
        moments = [state["exp_avg"].clone() for state in learner.optimizer.state.values()]
        with pytest.raises(NonFiniteError, match=message):
            learner.update(sample)
        assert all((new == old).all() for new, old in zip(everything, before, strict=True))
        assert all((s["exp_avg"] == m).all() for s, m in zip(learner.optimizer.state.values(), moments, strict=True))
        assert learner.updates == 1

    @pytest.mark.parametrize(("value", "shown"), [(float("nan"), "nan"), (float("inf"), "(inf|nan)")])
    @pytest.mark.parametrize("max_grad_norm", [None, 1.0])
    def test_a_loss_of_nan_stops_the_update(self, value, shown, max_grad_norm):
        learner, sample = self.poisoned(max_grad_norm=max_grad_norm)
        sample["next", "reward"].fill_(value)
        self.check_nothing_was_learned(learner, sample, f"^the loss became {shown} in update 2, frame 16$")

    def test_a_gradient_of_nan_stops_the_update(self):
        learner, sample = self.poisoned()
        name, parameter = list(learner.network.named_parameters())[-1]
        parameter.register_hook(lambda gradient: gradient * float("nan"))
        message = f"^the gradient of {name} became NaN or infinite in update 2, frame 16$"
        self.check_nothing_was_learned(learner, sample, message.replace(".", r"\."))

    def test_an_infinite_norm_of_finite_gradients_stops_the_update(self):
        learner, sample = self.poisoned(max_grad_norm=1.0)
        for parameter in learner.network.parameters():
            parameter.register_hook(lambda gradient: torch.full_like(gradient, 3e38))
        self.check_nothing_was_learned(learner, sample, "^the gradient's norm became infinite in update 2, frame 16$")


class TestSeparateParts:
    """Parts of a network that are optimised separately."""

    def updated(self, separate, **settings):
        """Which share of a parameter's first step each part made, and the gradients it was made with."""
        learner = make_learner(separate=separate, **settings)
        learner.store(make_batch())
        sample = learner.sample()
        before = {name: p.detach().clone() for name, p in learner.network.named_parameters()}
        metrics = learner.update(sample)
        steps = {name: (p - before[name]).abs().max().item() for name, p in learner.network.named_parameters()}
        return steps, metrics, {name: p.grad for name, p in learner.network.named_parameters()}

    def test_each_separate_part_has_its_rate(self):
        """Adam's first step is as long as its rate."""
        steps, _, _ = self.updated({"network.head": 0.25}, learning_rate=0.01)
        for name, step in steps.items():
            assert step == pytest.approx(0.0025 if "head" in name else 0.01, rel=1e-3)

    def test_rates_of_separate_parts_follow_the_schedule(self):
        schedule = {"learning_rate": 0.01, "learning_rate_end": 0.001, "learning_rate_frames": 16}
        learner = make_learner(separate={"network.head": 0.5}, **schedule)
        rates = [group["lr"] for group in learner.optimizer.param_groups]
        learner.store(make_batch())
        rates += [group["lr"] for group in learner.optimizer.param_groups]
        assert rates == pytest.approx([0.01, 0.005, 0.001, 0.0005])

    def test_each_separate_part_is_clipped_by_its_own_norm(self):
        _, metrics, together = self.updated(None, max_grad_norm=1e-3)
        _, same, apart = self.updated({"network.head": 1.0}, max_grad_norm=1e-3)
        assert metrics["grad_norm"] == same["grad_norm"] > 1e-3

        def norm(gradients, part):
            return torch.stack([g.norm() for name, g in gradients.items() if ("head" in name) == part]).norm().item()

        assert norm(together, True) ** 2 + norm(together, False) ** 2 == pytest.approx(1e-6, rel=1e-2)
        assert norm(apart, True) == pytest.approx(1e-3, rel=1e-2) == norm(apart, False)

    @pytest.mark.parametrize("separate", [{"network.haed": 1.0}, {"network.head": 0.0}], ids=str)
    def test_wrong_separate_parts_are_refused(self, separate):
        with pytest.raises(ValueError, match="separate must map prefixes of parameters' names to shares > 0"):
            make_learner(separate=separate)


class TestNumbersThatAreNoneOnAGPU:
    """There the host looks later; until then the optimiser leaves the weights alone by itself."""

    def poisoned(self):
        learner = make_learner(max_grad_norm=1.0, learning_rate=0.1)
        learner.guard.at_once = False
        learner.store(make_batch())
        learner.learn()
        sample = learner.sample()
        sample["next", "reward"].fill_(float("nan"))
        return learner, sample

    def test_no_later_update_reaches_the_weights_on_a_gpu(self):
        learner, sample = self.poisoned()
        states = learner.optimizer.state.values()
        before = [value.clone() for value in learner.network.parameters()]
        moments = [value.clone() for state in states for value in state.values()]
        for each in (sample, learner.sample()):
            learner.update(each)
            assert all((new == old).all() for new, old in zip(learner.network.parameters(), before, strict=True))
            assert [value.tolist() for state in states for value in state.values()] == [v.tolist() for v in moments]

    @pytest.mark.parametrize("look", ["check_finite", "state_dict", "store"])
    def test_check_finite_reports_a_nan_on_a_gpu(self, look):
        learner, sample = self.poisoned()
        learner.update(sample)
        learner.learn()
        arguments = [make_batch()] if look == "store" else []
        with pytest.raises(NonFiniteError, match=r"^the loss became nan in update 2, frame 16$"):
            getattr(learner, look)(*arguments)

    def test_finite_updates_on_a_gpu_equal_those_on_a_cpu(self):
        learners = [make_learner(max_grad_norm=1.0, learning_rate=0.1) for _ in range(2)]
        learners[1].guard.at_once = False
        torch.manual_seed(1)
        for _ in range(4):
            sample = make_batch()
            for learner in learners:
                learner.update(sample.clone())
        learners[1].check_finite()
        params = [learner.loss.value_network_params.data for learner in learners]
        assert parameter_distance(*params) == 0


class TestPrecision:
    def chosen(self, monkeypatch, choice, **settings):
        monkeypatch.setattr(learner_module, "choose_precision", lambda wanted, _: {"auto": choice}.get(wanted, wanted))
        return make_learner(extract=Keep(), **settings)

    def test_the_precision_that_auto_chose_is_kept_on_another_machine(self, monkeypatch):
        first = self.chosen(monkeypatch, "bf16", precision="auto")
        second = self.chosen(monkeypatch, "fp32", precision="auto")
        assert (first.precision, second.precision) == ("bf16", "fp32")
        second.load_state_dict(first.state_dict())
        assert second.precision == "bf16"

    def test_an_explicit_precision_is_kept(self, monkeypatch):
        first = self.chosen(monkeypatch, "bf16", precision="auto")
        second = make_learner(extract=Keep(), precision="fp32")
        second.load_state_dict(first.state_dict())
        assert second.precision == "fp32"

    def test_a_state_older_than_the_precision_setting_stays_in_fp32(self, monkeypatch):
        state = make_learner(extract=Keep()).state_dict()
        del state["precision"]
        second = self.chosen(monkeypatch, "bf16", precision="auto")
        second.load_state_dict(state)
        assert second.precision == "fp32"


@pytest.mark.parametrize(
    ("settings", "loss", "message"),
    [
        ({"n_step": 3}, {}, "n_step must be that of the loss, which has 1, got 3"),
        ({"double": False}, {}, "double must be that of the loss, which has True, got False"),
        ({"max_target": 2.0}, {"max_target": 1.0}, "max_target must be that of the loss, which has 1.0, got 2.0"),
        ({"stored_state": True}, {}, "stored_state must be that of the loss, which has False, got True"),
        ({"burn_in": 0.25}, {}, "burn_in must be that of the loss, which has 0.5, got 0.25"),
        ({"burn_in": 0.75}, {"burn_in": 0.0}, "burn_in must be that of the loss, which has 0.0, got 0.75"),
        ({"max_target": "unbounded"}, {"max_target": 1.0}, "max_target must be that of the loss, which has 1.0"),
        ({"max_target": "unbounded"}, {}, None),
        ({"burn_in": 0.25, "n_step": 3, "double": False}, {"burn_in": 0.25, "n_step": 3, "double": False}, None),
        ({}, {"n_step": 3, "burn_in": 0.0}, None),  # a loss may have its own
    ],
)
def test_a_loss_that_was_built_with_other_settings_is_refused(settings, loss, message):
    """It would learn by its own, and the settings would say something else."""
    controller = SubController(
        QNetwork(FullyConnectedFeatures(3, (8,)), num_actions=2, hidden_size=6), subgoal_key=None, init_key="is_init"
    )

    def make():
        return Learner(
            controller,
            tiny_settings(**settings),
            extract=lambda batch: batch,
            loss=RecurrentDQNLoss(controller, lookahead=1 + 2 * (loss.get("n_step", 1) > 1), **loss),
            num_envs=2,
        )

    if message is None:
        make()
    else:
        with pytest.raises(ValueError, match=f"settings.{message}.*; build it with make_recurrent_loss"):
            make()


@pytest.mark.parametrize("name", ["v2", "v3", "drqn"])
def test_a_copy_of_an_agent_learns_as_the_agent_does(name):
    """Networks, what losses register, target networks and optimisers belong together in the copy, too."""
    env = small_env(4)
    algorithm = build(name, env)
    batches = collect(algorithm, env, 30, batches=3)
    for batch in batches:
        algorithm.observe(batch)
    copy, reports = deepcopy(algorithm), []
    for each in (algorithm, copy):
        torch.manual_seed(0)
        before = deepcopy(dict(each.policy.named_parameters()))
        losses = [learner.learn()["loss"] for _ in range(3) for learner in each.learners.values()]
        assert any(not torch.equal(before[key], value) for key, value in each.policy.named_parameters())
        reports.append(torch.stack(losses))
    assert torch.equal(*reports) and len(reports[0].unique()) > 1
    for level, learner in algorithm.learners.items():
        theirs = copy.learners[level].loss.state_dict()
        assert all(torch.equal(value, theirs[key]) for key, value in learner.loss.state_dict().items())
    for (key, one), other in zip(algorithm.policy.named_parameters(), copy.policy.parameters(), strict=True):
        assert torch.equal(one, other) and one is not other, key
