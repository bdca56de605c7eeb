from copy import deepcopy

import pytest
import torch
from helpers import small_env, tiny_settings
from tensordict import TensorDict
from torchrl.envs import ExplorationType, set_exploration_type
from torchrl.modules import set_recurrent_mode

from hdrqn_torchrl.algorithms import make_v3
from hdrqn_torchrl.keys import OptionKeys
from hdrqn_torchrl.modules import (
    AllSubgoalsNetwork,
    AllSubgoalsPolicy,
    EpsilonGreedy,
    FullyConnectedFeatures,
    RepeatingEpsilonGreedy,
    compact_network,
)
from hdrqn_torchrl.modules.all_subgoals import values_of

EXACT = {"rtol": 0, "atol": 1e-6}
ACTIONS, SUBGOALS = 3, 4


def make_network(**settings):
    torch.manual_seed(0)
    sizes = {"num_actions": ACTIONS, "num_subgoals": SUBGOALS, "hidden_size": 5, "head_size": 7}
    return AllSubgoalsNetwork(FullyConnectedFeatures(2, (6,)), **(sizes | settings))


def sequences(rows=3, steps=9):
    """Inputs of ``unroll``; each row starts with an episode, and others start in the middle of it."""
    torch.manual_seed(1)
    observation, action = torch.randn(rows, steps, 2), torch.randint(ACTIONS, (rows, steps))
    init, mask = torch.rand(rows, steps) < 0.3, torch.rand(rows, steps, SUBGOALS) < 0.7
    init[:, 0], init[:, 4] = True, True
    return observation, action, init, mask


def unroll(network, observation, action, init, mask, state=None):
    """Values of both levels, and the memory's output."""
    (action_value, subgoal_value), memory = network.unroll(observation, action, init, [mask], state)
    return action_value, subgoal_value.squeeze(-2), memory


def step(network, observation, action, init, mask, state):
    (action_value, subgoal_value), state = network.step(observation, action, init, [mask], state)
    return action_value, subgoal_value.squeeze(-2), state


def step_by_step(network, observation, action, init, mask, state):
    """The outputs of ``unroll``, computed step by step."""
    values = []
    for t in range(observation.shape[1]):
        *value, state = step(network, observation[:, t], action[:, t], init[:, t], mask[:, t], state)
        values.append(value)
    return [torch.stack(parts, 1) for parts in zip(*values, strict=True)]


class TestNetwork:
    @pytest.mark.parametrize("from_the_start", [True, False])
    def test_step_by_step_and_unrolled_values_agree(self, from_the_start):
        network, inputs = make_network(), sequences()
        inputs[2][:, 0] = from_the_start
        state = tuple(torch.randn(2, 3, 5))
        unrolled = unroll(network, *inputs, state)
        for found, expected in zip(unrolled[:2], step_by_step(network, *inputs, state), strict=True):
            torch.testing.assert_close(found, expected, **EXACT)
        from_zero = unroll(network, *inputs)
        same = all((a == b).all() for a, b in zip(unrolled, from_zero, strict=True))
        assert same == from_the_start

    def test_step_works_without_batch_dimension(self):
        network, (observation, action, init, mask) = make_network(), sequences(rows=2)
        init = torch.tensor([True, False])
        state = tuple(torch.randn(2, 2, 5))
        batch = observation[:, 1], action[:, 1], init, mask[:, 1]
        whole = step(network, *batch, state)
        for row in range(2):
            single = step(network, *(entry[row] for entry in batch), tuple(part[row] for part in state))
            for found, expected in zip((*single[:2], *single[2]), (*whole[:2], *whole[2]), strict=True):
                torch.testing.assert_close(found, expected[row], **EXACT)

    def test_values_do_not_depend_on_earlier_episodes(self):
        network, (observation, action, init, mask) = make_network(), sequences()
        before = unroll(network, observation, action, init, mask)
        observation[:, :4], mask[:, :4] = torch.randn(3, 4, 2), True
        action[:, :5] = (action[:, :5] + 1) % ACTIONS  # that of the last step before, too
        for old, new in zip(before, unroll(network, observation, action, init, mask), strict=True):
            assert (old[:, 4:] == new[:, 4:]).all() and (old[:, :4] != new[:, :4]).any()

    def test_values_depend_on_earlier_observations_and_actions_of_the_episode(self):
        network, (observation, action, init, mask) = make_network(), sequences()
        init[:, 1:] = False
        before = unroll(network, observation, action, init, mask)[0]
        other = observation.clone()
        other[:, 0] += 1
        assert (before != unroll(network, other, action, init, mask)[0]).flatten(2).any(-1).all()
        action[:, 3] = (action[:, 3] + 1) % ACTIONS
        differs = (before != unroll(network, observation, action, init, mask)[0]).flatten(2).any(-1)
        assert differs[:, 3:].all() and not differs[:, :3].any()

    def test_the_mask_affects_only_the_meta_level(self):
        network, (observation, action, init, mask) = make_network(), sequences()
        before, after = (unroll(network, observation, action, init, which) for which in (mask, ~mask))
        assert (before[0] == after[0]).all() and (before[1] != after[1]).any(-1).all()

    def test_values_are_dueling(self):
        """The mean over actions equals the value stream; differences equal those of the advantages."""
        network, inputs = make_network(), sequences(rows=1)
        streams = []
        for head in (network.sub_head, network.meta_head):
            head.register_forward_hook(lambda _module, _inputs, output: streams.append(output))
        action_value, subgoal_value, _ = step(network, *(steps[0] for steps in inputs), network.initial_state(9))
        sub, meta = streams[0].view(*action_value.shape[:-1], 1 + ACTIONS), streams[1]
        for value, stream in ((action_value, sub), (subgoal_value, meta)):
            torch.testing.assert_close(value.mean(-1), stream[..., 0], **EXACT)
            torch.testing.assert_close(value.diff(dim=-1), stream[..., 1:].diff(dim=-1), **EXACT)

    @pytest.mark.parametrize("joint", [True, False])
    def test_only_a_joint_meta_level_trains_the_memory(self, joint):
        network = make_network(joint=joint)
        unroll(network, *sequences())[1].sum().backward()
        for part in (network.memory, network.features):
            assert any(p.grad is not None and (p.grad != 0).any() for p in part.parameters()) == joint
        assert all((p.grad != 0).any() for p in network.meta_head.parameters())
        assert all(p.grad is None for p in network.sub_head.parameters())

    def test_values_do_not_depend_on_joint(self):
        joint, apart = make_network(), make_network(joint=False)
        for found, expected in zip(unroll(joint, *sequences()), unroll(apart, *sequences()), strict=True):
            assert (found == expected).all()

    def test_sizes_reach_the_layers_of_the_network(self):
        network = make_network(hidden_size=9, head_size=11)
        assert network.memory.hidden_size == 9 and network.initial_state(2, 3)[0].shape == (2, 3, 9)
        assert [head[0].out_features for head in (network.sub_head, network.meta_head)] == [11, 11]

    @pytest.mark.parametrize("name", ["hidden_size", "head_size"])
    def test_wrong_arguments_are_refused(self, name):
        with pytest.raises(ValueError, match=f"{name} must be >= 1, got 0; "):
            make_network(**{name: 0})


def root(rows=3, **entries):
    """Inputs of a policy: random observations and states, in the middle of episodes and options."""
    torch.manual_seed(1)
    td = TensorDict(observation=torch.randn(rows, 2), batch_size=rows)
    td["memory_hidden"], td["memory_cell"] = torch.randn(2, rows, 5)
    td["previous_action"] = torch.randint(ACTIONS, (rows,))
    td["active_subgoal"] = torch.zeros(rows, dtype=torch.int64)
    td["is_init"] = td["option_init"] = torch.zeros(rows, 1, dtype=torch.bool)
    td["subgoal_mask"] = torch.ones(rows, SUBGOALS, dtype=torch.bool)
    td["repeated_action"] = torch.zeros(rows, 2, dtype=torch.int64)
    return td.update(entries)


def values_at(policy, td):
    state = td["memory_hidden"], td["memory_cell"]
    read = (td["observation"], td["previous_action"], td["is_init"].squeeze(-1), td["subgoal_mask"])
    return step(policy.network, *read, state)


class TestPolicy:
    ALWAYS, NEVER = EpsilonGreedy(1.0, 1.0), EpsilonGreedy(0.0, 0.0)

    def test_the_subgoal_is_chosen_where_an_option_starts_and_kept_elsewhere(self):
        policy = AllSubgoalsPolicy(make_network())
        td = root(
            active_subgoal=torch.tensor([3, 2, 1]),
            option_init=torch.tensor([[False], [True], [False]]),
            is_init=torch.tensor([[False], [False], [True]]),
        )
        action_value, subgoal_value, (hidden, cell) = values_at(policy, td)
        out = policy(td.clone())
        subgoal = torch.tensor([3, subgoal_value[1].argmax().item(), 1])
        assert out["subgoal"].tolist() == subgoal.tolist()
        assert (out["action"] == action_value[torch.arange(3), subgoal].argmax(-1)).all()
        assert (out["next", "memory_hidden"] == hidden).all() and (out["next", "memory_cell"] == cell).all()
        assert (out["next", "previous_action"] == out["action"]).all()

    def test_the_memory_restarts_with_episodes_but_not_with_options(self):
        policy = AllSubgoalsPolicy(make_network())
        yes = torch.ones(3, 1, dtype=torch.bool)
        kept, option, episode = (policy(root(**entry)) for entry in ({}, {"option_init": yes}, {"is_init": yes}))
        fresh = policy(root(is_init=yes, memory_hidden=torch.zeros(3, 5), memory_cell=torch.zeros(3, 5)))
        state = ("next", "memory_hidden")
        assert (kept[state] == option[state]).all()
        assert (kept[state] != episode[state]).any(-1).all() and (fresh[state] == episode[state]).all()

    def test_only_subgoals_in_the_mask_are_chosen(self):
        policy = AllSubgoalsPolicy(make_network())
        td = root(option_init=torch.ones(3, 1, dtype=torch.bool))
        for left in range(SUBGOALS):
            td["subgoal_mask"] = (torch.arange(SUBGOALS) == left).expand(3, SUBGOALS)
            for exploration in (self.NEVER, self.ALWAYS):
                policy.meta_exploration = exploration
                with set_exploration_type(ExplorationType.RANDOM):
                    assert (policy(td.clone())["subgoal"] == left).all()

    def test_each_level_explores_by_its_own_epsilon(self):
        td = root(rows=1).expand(400).clone()
        td["option_init"] = torch.ones(400, 1, dtype=torch.bool)
        for sub, meta in ((self.ALWAYS, None), (None, self.ALWAYS), (self.NEVER, deepcopy(self.NEVER))):
            policy = AllSubgoalsPolicy(make_network(), sub, meta)
            with set_exploration_type(ExplorationType.RANDOM):
                out = policy(td.clone())
            with set_exploration_type(ExplorationType.DETERMINISTIC):
                greedy = policy(td.clone())
            assert len(greedy["subgoal"].unique()) == 1
            assert len(out["subgoal"].unique()) == (SUBGOALS if meta is self.ALWAYS else 1)
            actions_by_subgoal = torch.stack([out["subgoal"], out["action"]], -1).unique(dim=0)
            per_subgoal = len(actions_by_subgoal) // len(out["subgoal"].unique())
            assert per_subgoal == (ACTIONS if sub is self.ALWAYS else 1)

    def test_a_random_stretch_in_progress_continues(self):
        policy = AllSubgoalsPolicy(make_network(), RepeatingEpsilonGreedy(0.0, 0.0))
        greedy = policy(root())["action"]
        other = (greedy + 1) % ACTIONS
        stretches = torch.stack([other, torch.tensor([2, 1, 0])], -1)
        td = root(repeated_action=stretches, option_init=torch.zeros(3, 1, dtype=torch.bool))
        with set_exploration_type(ExplorationType.RANDOM):
            out = policy(td)
        assert out["action"].tolist() == [other[0], other[1], greedy[2]]
        assert out["next", "repeated_action"][:, 1].tolist() == [1, 0, 0]
        assert (out["next", "previous_action"] == out["action"]).all()

    @pytest.mark.parametrize("exploration", [None, RepeatingEpsilonGreedy()], ids=["greedy", "repeating"])
    def test_the_policy_reads_in_keys_and_writes_out_keys(self, exploration):
        policy = AllSubgoalsPolicy(make_network(), exploration)
        read = root().select(*policy.in_keys)
        assert len(read.keys()) == len(policy.in_keys)
        out = policy(read.clone())
        assert set(policy.out_keys) == set(out.keys(True, True)) - set(read.keys(True, True))

    def test_all_keys_can_be_renamed_and_nested(self):
        plain = AllSubgoalsPolicy(make_network(), RepeatingEpsilonGreedy())
        own = ("observation", "previous_action", "is_init", "action", "memory_hidden", "memory_cell", "repeated_action")
        arguments = {"is_init": "init_key", "memory_hidden": "hidden_key", "memory_cell": "cell_key"}
        arguments["repeated_action"] = "exploration_key"
        read = {arguments.get(name, f"{name}_key"): ("agent", name) for name in own}
        moved = AllSubgoalsPolicy(plain.network, plain.sub_exploration, subgoal_keys=[OptionKeys("rooms")], **read)
        td = root(option_init=torch.tensor([[False], [True], [False]]))
        renamed = {("agent", key) if key in own else f"rooms_{key}": value for key, value in td.items()}
        out, expected = moved(TensorDict(renamed, batch_size=3)), plain(td)
        assert (out["agent", "action"] == expected["action"]).all()
        assert (out["rooms_subgoal"] == expected["subgoal"]).all()
        for key in ("memory_hidden", "memory_cell", "previous_action", "repeated_action"):
            assert (out["next", "agent", key] == expected["next", key]).all()
            assert ("agent", key) in moved.make_tensordict_primer().primers.keys(True, True)

    def test_in_learning_all_values_are_written_and_nothing_is_chosen(self):
        policy, (observation, action, init, mask) = AllSubgoalsPolicy(make_network()), sequences()
        td = TensorDict(observation=observation, previous_action=action, subgoal_mask=mask, batch_size=(3, 9))
        td["is_init"] = init.unsqueeze(-1)
        with set_recurrent_mode(True):
            out = policy(td)
        expected = unroll(policy.network, observation, action, init, mask)
        assert (out["action_value"] == expected[0]).all() and (out["subgoal_value"].squeeze(-2) == expected[1]).all()
        assert "action" not in out and "next" not in out

    def test_all_outputs_are_on_the_device_of_the_inputs(self):
        """Mixing devices raises an error."""
        policy = AllSubgoalsPolicy(make_network(), RepeatingEpsilonGreedy(ladder=1.0), EpsilonGreedy(ladder=1.0))
        policy = policy.to("meta")
        with set_exploration_type(ExplorationType.RANDOM):
            out = policy(root().to("meta"))
        assert out["action"].device.type == out["next", "repeated_action"].device.type == "meta"
        assert all(
            value.device.type == "meta" for value in unroll(policy.network, *(x.to("meta") for x in sequences()))
        )


def test_values_of_selects_the_values_of_one_subgoal():
    values = torch.arange(12.0).view(2, 3, 2)
    assert values_of(values, torch.tensor([2, 0])).tolist() == [[4.0, 5.0], [6.0, 7.0]]
    assert values_of(values[0], torch.tensor(1)).tolist() == [2.0, 3.0]
    assert values_of(values[None], torch.tensor([[1, 1]])).tolist() == [[[2.0, 3.0], [8.0, 9.0]]]


class TestInTheEnvironment:
    """Random and greedy rollouts through many short episodes, with the values that were acted by."""

    def play(self, steps=40, *, epsilon=0.5, kind=ExplorationType.RANDOM, max_steps=6, learner=None, **options):
        torch.manual_seed(0)
        env = small_env(5, max_steps=max_steps)
        schedules = {
            "sub_exploration": RepeatingEpsilonGreedy(epsilon, epsilon, exponent=0.2),
            "meta_exploration": EpsilonGreedy(epsilon, epsilon),
        }
        settings = tiny_settings(**({"sampling": "episode_starts", "slice_len": 9, "batch_size": 32} | (learner or {})))
        self.algorithm = make_v3(
            env, compact_network(8, (8,)), learner=settings, memory_size=6, head_size=6, **(schedules | options)
        )
        policy, acted_by = self.algorithm.policy, []
        decide = policy.network.step
        policy.network.step = lambda *inputs: acted_by.append(decide(*inputs)) or acted_by[-1]
        with set_exploration_type(kind), torch.no_grad():
            batch = self.algorithm.transform(env).rollout(steps, policy, break_when_any_done=False)
        batch["collector", "traj_ids"] = batch["is_init"].squeeze(-1).cumsum(-1) + 100 * torch.arange(5)[:, None]
        values = [torch.stack(of_level, 1) for of_level in zip(*(values for values, _ in acted_by), strict=True)]
        self.action_value, self.subgoal_value = values[0], values[1].squeeze(-2)
        assert self.action_value.shape == (5, steps, 2, 4)
        return batch

    def unrolled(self, batch):
        with set_recurrent_mode(True), torch.no_grad():
            out = self.algorithm.policy(batch.clone())
        return out["action_value"], out["subgoal_value"].squeeze(-2)

    def test_whole_rollouts_unroll_to_the_values_acted_by(self):
        batch = self.play(max_option_steps=3)
        assert batch["is_init"][:, 1:].sum() > 20
        action_value, subgoal_value = self.unrolled(batch)
        torch.testing.assert_close(action_value, self.action_value, **EXACT)
        torch.testing.assert_close(subgoal_value, self.subgoal_value, **EXACT)

    def test_replayed_sequences_unroll_to_the_values_acted_by(self):
        """Slices from the replay memory that start with an episode and continue through others."""
        batch = self.play(max_option_steps=3)
        learner = self.algorithm.learners["joint"]
        learner.store(batch)
        trajectory = batch["collector", "traj_ids"]
        first = batch["is_init"].squeeze(-1)
        place = dict(zip(trajectory[first].tolist(), first.nonzero().tolist(), strict=True))
        sample = learner.sample()
        assert sample.shape == (32, 10) and sample["is_init"][:, 1:].any()
        for values, acted_by in zip(self.unrolled(sample), (self.action_value, self.subgoal_value), strict=True):
            for row in range(len(sample)):
                env, time = place[sample["collector", "traj_ids"][row, 0].item()]
                assert (trajectory[env, time : time + 10] == sample["collector", "traj_ids"][row]).all()
                torch.testing.assert_close(values[row], acted_by[env, time : time + 10], **EXACT)

    @pytest.mark.parametrize("sampling", ["steps", "episodes"])
    def test_sequences_from_the_middle_unroll_to_the_values_acted_by(self, sampling):
        """Slices that start from stored states and end with their episode."""
        batch = self.play(learner={"sampling": sampling, "stored_state": True, "slice_len": 4})
        learner, time = self.algorithm.learners["joint"], torch.arange(40).expand(5, 40)
        batch["time"], batch["env"] = time.contiguous(), torch.arange(5)[:, None].expand(5, 40).contiguous()
        learner.extract.root_keys += ["time", "env"]
        learner.store(batch)
        sample = learner.sample()
        assert sample.shape == (32, 4 + learner.loss.lookahead) and (~sample["is_init"][:, 0]).sum() > 10
        real, place = sample["collector", "mask"], (sample["env"], sample["time"])
        assert not real.all()
        for values, acted_by in zip(self.unrolled(sample), (self.action_value, self.subgoal_value), strict=True):
            torch.testing.assert_close(values[real], acted_by[place][real], **EXACT)

    def test_state_is_carried_between_steps_and_empty_at_the_start_of_episodes(self):
        batch = self.play()
        init, carried = batch["is_init"].squeeze(-1), ("memory_hidden", "memory_cell", "previous_action")
        for key in (*carried, "repeated_action"):
            assert (batch[key][init] == 0).all(), key
            going_on = ~init[:, 1:]
            assert (batch[key][:, 1:][going_on] == batch["next", key][:, :-1][going_on]).all(), key
        assert (batch["previous_action"][:, 1:] == batch["action"][:, :-1])[~init[:, 1:]].all()
        ended = batch["next", "done"].squeeze(-1)
        assert (batch["next", "repeated_action"][ended][:, 1] > 0).any()  # stretches that did not survive

    def test_the_active_subgoal_is_the_one_that_the_policy_chose(self):
        batch = self.play(max_option_steps=3)
        assert (batch["subgoal"] == batch["next", "active_subgoal"]).all()
        inside = ~batch["option_init"].squeeze(-1)
        assert inside.any() and (batch["subgoal"] == batch["active_subgoal"])[inside].all()
        starts = batch["option_init"].squeeze(-1)
        assert batch["subgoal_mask"].gather(-1, batch["subgoal"][..., None])[starts].all()

    @pytest.mark.parametrize("kind", [ExplorationType.DETERMINISTIC, ExplorationType.RANDOM])
    def test_without_exploration_the_policy_is_greedy(self, kind):
        """Also with an epsilon of 0."""
        epsilon = 0.0 if kind == ExplorationType.RANDOM else 1.0
        batch = self.play(epsilon=epsilon, kind=kind, max_option_steps=2)
        starts = batch["option_init"].squeeze(-1)
        allowed = self.subgoal_value.masked_fill(~batch["subgoal_mask"], -torch.inf)
        assert (batch["subgoal"] == allowed.argmax(-1))[starts].all()
        in_force = batch["subgoal"][..., None, None].expand(-1, -1, 1, 4)
        assert (batch["action"] == self.action_value.gather(2, in_force).squeeze(2).argmax(-1)).all()
        assert (batch["next", "repeated_action"][..., 1] == 0).all()
