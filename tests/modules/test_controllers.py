import pytest
import torch
from helpers import build, collect, options_of, small_env, tiny_settings
from tensordict import TensorDict
from tensordict.nn import TensorDictSequential
from torchrl.collectors import MultiSyncCollector
from torchrl.envs import ExplorationType, TransformedEnv, set_exploration_type
from torchrl.modules import set_recurrent_mode

from hdrqn_torchrl.modules import (
    EpsilonGreedy,
    FullyConnectedFeatures,
    MetaController,
    QNetwork,
    SubController,
    compact_network,
    paper_network,
)

EXACT = {"rtol": 1e-4, "atol": 1e-5}


def make_network(num_actions=3, num_conditions=0, recurrent=True):
    torch.manual_seed(0)
    features = FullyConnectedFeatures(2, (6,))
    settings = {"num_actions": num_actions, "num_conditions": num_conditions, "recurrent": recurrent}
    return QNetwork(features, hidden_size=5, **settings)


def root(rows=3, **entries):
    """What a controller reads: random observations and states, no option starting."""
    torch.manual_seed(1)
    td = TensorDict(observation=torch.randn(rows, 2), batch_size=rows)
    for key in ("sub_hidden", "sub_cell", "meta_hidden", "meta_cell"):
        td[key] = torch.randn(rows, 5)
    td["subgoal"] = td["active_subgoal"] = torch.zeros(rows, dtype=torch.int64)
    td["option_init"] = torch.zeros(rows, 1, dtype=torch.bool)
    td["subgoal_mask"] = torch.ones(rows, 3, dtype=torch.bool)
    return td.update(entries)


def test_controllers_state_all_that_they_read():
    meta, sub = MetaController(make_network()), SubController(make_network(num_conditions=3))
    chain = TensorDictSequential(meta, sub)
    read = root().exclude("subgoal").select(*chain.in_keys)
    assert {"active_subgoal", "option_init", "subgoal_mask"} <= set(chain.in_keys) and "subgoal" not in chain.in_keys
    assert (chain(read)["subgoal"] == 0).all()  # no option starts: the choice is kept


class TestSubController:
    def test_its_state_restarts_from_zero_where_an_option_starts_and_only_there(self):
        sub = SubController(make_network(num_conditions=2))
        started = torch.tensor([[False], [True], [False]])
        td, zeroed = root(option_init=started), root()
        for key in ("sub_hidden", "sub_cell"):
            zeroed[key][1] = 0.0
        for key in ("sub_hidden", "sub_cell"):
            torch.testing.assert_close(sub(td.clone())["next", key], sub(zeroed.clone())["next", key])
        kept, restarted = sub(root())["next", "sub_hidden"], sub(td)["next", "sub_hidden"]
        assert (kept != restarted).any(-1).tolist() == [False, True, False]

    def test_it_is_greedy_without_exploration(self):
        sub = SubController(make_network(), subgoal_key=None)
        td = root(option_init=torch.ones(3, 1, dtype=torch.bool))
        with set_exploration_type(ExplorationType.RANDOM):
            action = sub(td)["action"]
        value, _ = sub.network.step(td["observation"], None, sub.network.initial_state(3))
        assert (action == value.argmax(-1)).all()

    def test_it_writes_what_it_promises_from_what_it_asks_for(self):
        for recurrent in (True, False):
            sub = SubController(make_network(num_conditions=2, recurrent=recurrent))
            read = root().select(*sub.in_keys)
            out = sub(read.clone())
            assert set(sub.out_keys) == set(out.keys(True, True)) - set(read.keys(True, True))

    def test_every_key_can_be_nested(self):
        names = ("observation", "subgoal", "action", "action_value")
        nested = {f"{name}_key": ("agent", name) for name in names}
        nested |= {"init_key": ("agent", "init"), "hidden_key": ("agent", "h"), "cell_key": ("agent", "c")}
        plain, moved = SubController(make_network(num_conditions=2)), None
        moved = SubController(plain.network, **nested)
        td, agent = root(), root()
        agent = agent.rename_key_("option_init", "init").rename_key_("sub_hidden", "h").rename_key_("sub_cell", "c")
        out = moved(TensorDict(agent=agent, batch_size=3))
        expected = plain(td)
        assert (out["agent", "action"] == expected["action"]).all()
        assert (out["next", "agent", "h"] == expected["next", "sub_hidden"]).all()
        assert moved.make_tensordict_primer().primers["agent", "h"].shape == (5,)

    @pytest.mark.parametrize(("subgoal_key", "conditions"), [(None, 2), ("subgoal", 0)])
    def test_a_network_that_does_not_fit_the_subgoal_key(self, subgoal_key, conditions):
        with pytest.raises(ValueError, match=r"subgoal_key must be None exactly when.*num_conditions="):
            SubController(make_network(num_conditions=conditions), subgoal_key=subgoal_key)


class TestMetaController:
    def test_where_no_option_starts_everything_is_kept(self):
        meta = MetaController(make_network())
        td = root(active_subgoal=torch.tensor([2, 1, 0]), option_init=torch.tensor([[False], [True], [False]]))
        out = meta(td.clone())
        assert out["subgoal"][[0, 2]].tolist() == [2, 0]
        for key in ("meta_hidden", "meta_cell"):
            assert (out["next", key] == td[key]).all(-1).tolist() == [True, False, True]

    def test_where_an_option_starts_it_chooses_the_best_subgoal_and_advances_its_state(self):
        meta = MetaController(make_network())
        td = root(option_init=torch.ones(3, 1, dtype=torch.bool))
        out = meta(td.clone())
        value, (hidden, cell) = meta.network.step(td["observation"], None, (td["meta_hidden"], td["meta_cell"]))
        assert (out["subgoal"] == value.argmax(-1)).all()
        assert (out["next", "meta_hidden"] == hidden).all() and (out["next", "meta_cell"] == cell).all()

    def test_the_mask_is_honoured_unless_it_is_switched_off(self):
        meta, unmasked = MetaController(make_network()), MetaController(make_network(), mask_key=None)
        td = root(option_init=torch.ones(3, 1, dtype=torch.bool))
        free = unmasked(td.clone())["subgoal"]
        td["subgoal_mask"] = torch.arange(3) != free[:, None]
        assert (meta(td.clone())["subgoal"] != free).all() and (unmasked(td.clone())["subgoal"] == free).all()

    def test_several_inputs_are_put_side_by_side(self):
        features = FullyConnectedFeatures(10, (6,))
        network = QNetwork(features, num_actions=3, hidden_size=5)
        both = MetaController(network, input_keys=["sub_hidden", "sub_cell"])
        joined = MetaController(network, input_keys=["joined"])
        td = root(option_init=torch.ones(3, 1, dtype=torch.bool))
        td["joined"] = torch.cat([td["sub_hidden"], td["sub_cell"]], -1)
        assert (both(td.clone())["next", "meta_hidden"] == joined(td.clone())["next", "meta_hidden"]).all()


class TestHierarchicalPolicy:
    @pytest.mark.parametrize("options", [{"version": "v1"}, {}, {"meta_input_time": "after_last_observation"}], ids=str)
    def test_it_writes_what_it_promises_from_what_it_asks_for(self, options):
        env = small_env(3)
        algorithm = build(options.get("version", "v2"), env, **{k: v for k, v in options.items() if k != "version"})
        policy, read = algorithm.policy, algorithm.transform(env).reset()
        read = read.select(*policy.in_keys, strict=True)
        out = policy(read.clone())
        assert set(policy.out_keys) == set(out.keys(True, True)) - set(read.keys(True, True))

    def test_the_sub_controller_pursues_the_subgoal_just_chosen(self):
        env = small_env(8)
        algorithm = build("v2", env)
        td = algorithm.transform(env).reset()
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            out = algorithm.policy(td.clone())
        sub = algorithm.policy.sub_controller
        zero = sub.network.initial_state(8)
        _, (hidden, _) = sub.network.step(td["observation"], out["subgoal"], zero)
        torch.testing.assert_close(out["next", "sub_hidden"], hidden)


@pytest.fixture(scope="module")
def steps():
    """Consecutive steps of v2 in worlds whose episodes and options end at different times."""
    torch.manual_seed(0)
    env = small_env(6)
    return torch.cat(collect(build("v2", env, max_option_steps=4), env, 10, batches=6), 1)


class TestAlongEpisodes:
    def test_the_meta_state_changes_where_an_option_starts_and_nowhere_else(self, steps):
        for key in ("meta_hidden", "meta_cell"):
            changed = (steps["next", key] != steps[key]).any(-1, keepdim=True)
            assert (changed == steps["option_init"]).all()

    def test_states_are_zero_where_an_episode_starts_and_are_handed_on_elsewhere(self, steps):
        first = steps["is_init"].squeeze(-1)
        assert (first.any(0) & ~first.all(0)).any()  # some resets were partial
        for key in ("meta_hidden", "meta_cell", "sub_hidden", "sub_cell"):
            assert not steps[key][first].any(), key
            assert (steps[key][:, 1:] == steps["next", key][:, :-1])[~first[:, 1:]].all(), key

    def test_the_meta_controller_reads_the_state_in_which_the_last_option_ended(self, steps):
        start = steps["option_init"].squeeze(-1) & ~steps["is_init"].squeeze(-1)
        assert start.any() and steps["sub_hidden"][start].any(-1).all()

    def test_the_subgoal_is_constant_inside_an_option_and_never_one_that_is_gone(self, steps):
        inside = ~steps["option_init"][:, 1:].squeeze(-1)
        assert (steps["subgoal"][:, 1:] == steps["subgoal"][:, :-1])[inside].all()
        assert (steps["next", "active_subgoal"] == steps["subgoal"]).all()
        allowed = steps["subgoal_mask"].gather(-1, steps["subgoal"].unsqueeze(-1))
        assert allowed[steps["option_init"]].all()

    def test_a_partial_reset_leaves_the_neighbours_states_alone(self):
        env = small_env(3)
        algorithm = build("v2", env)
        transformed = algorithm.transform(env)
        td = transformed.rollout(3, algorithm.policy, break_when_any_done=False, auto_reset=True)[:, -1]["next"]
        before = td.exclude("reward", "extrinsic_reward", "intrinsic_reward")
        request = before.clone().set("_reset", torch.tensor([[False], [True], [False]]))
        after = transformed.reset(request)
        for key in ("meta_hidden", "meta_cell", "sub_hidden", "sub_cell"):
            assert (after[key][[0, 2]] == before[key][[0, 2]]).all()
            assert before[key][1].any() and not after[key][1].any()


NETWORKS = {"compact": compact_network(12, (16,)), "paper": paper_network(12)}


class TestActingAndLearningAgree:
    """The Q-values of the rollout, recomputed from the stored sequences by the learning path."""

    def collected(self, name, network, recurrent=True, **options):
        torch.manual_seed(0)
        env = small_env(3)
        if not recurrent:
            options["recurrent"] = False
        algorithm = build(name, env, NETWORKS[network], **options)
        steps = torch.cat(collect(algorithm, env, 6, batches=5), 1)
        assert steps["is_init"][:, 1:].any()
        return algorithm, steps

    def learned_values(self, controller, sequences):
        with set_recurrent_mode(True), torch.no_grad():
            return controller(sequences.clone())[controller.action_value_key]

    @pytest.mark.parametrize("network", NETWORKS)
    def test_flat(self, network):
        algorithm, steps = self.collected("drqn", network)
        stored = algorithm.learners["flat"].extract(steps)
        acted = algorithm.policy.network.head(steps["next", "sub_hidden"])
        torch.testing.assert_close(self.learned_values(algorithm.policy, stored), acted.detach(), **EXACT)

    @pytest.mark.parametrize("network", NETWORKS)
    @pytest.mark.parametrize("name", ["v1", "v2"])
    def test_sub(self, name, network):
        algorithm, steps = self.collected(name, network, max_option_steps=3)
        sub = algorithm.policy.sub_controller
        stored = algorithm.learners["sub"].extract(steps)
        acted = sub.network.head(steps["next", "sub_hidden"])
        torch.testing.assert_close(self.learned_values(sub, stored), acted.detach(), **EXACT)

    @pytest.mark.parametrize("start", [0, 1, 4, 17])
    @pytest.mark.parametrize(("name", "level"), [("drqn", "flat"), ("v1", "sub"), ("v2", "sub")])
    def test_from_the_middle_on_with_stored_states(self, name, level, start):
        options = {} if name == "drqn" else {"max_option_steps": 5}
        algorithm, steps = self.collected(name, "compact", settings=tiny_settings(stored_state=True), **options)
        controller = algorithm.policy if name == "drqn" else algorithm.policy.sub_controller
        stored = algorithm.learners[level].extract(steps)[:, start:]
        acted = controller.network.head(steps["next", "sub_hidden"])[:, start:].detach()
        torch.testing.assert_close(self.learned_values(controller, stored), acted, **EXACT)
        inside = ~steps[controller.init_key][:, start].squeeze(-1)
        assert inside.any() == (start > 0)
        if start:  # without them, the values are others
            values = self.learned_values(controller, stored.exclude("sub_hidden", "sub_cell"))
            assert not torch.allclose(values[inside], acted[inside])

    @pytest.mark.parametrize("name", ["v1", "v2"])
    def test_every_single_option_with_stored_states(self, name):
        settings = tiny_settings(stored_state=True)
        algorithm, steps = self.collected(name, "compact", settings=settings, max_option_steps=2)
        meta = algorithm.policy.meta_controller
        stored, _ = options_of(algorithm.learners["meta"].extract(steps))
        starts = steps[steps["option_init"].squeeze(-1)]
        acted = meta.network.head(starts["next", "meta_hidden"]).detach()
        place = {(row["collector", "traj_ids"].item(), *row["meta_hidden"].tolist()): i for i, row in enumerate(starts)}
        assert len(place) == len(starts) and (~stored["is_init"]).sum() > 10
        rows = [place[row["collector", "traj_ids"].item(), *row["meta_hidden"].tolist()] for row in stored]
        learned = self.learned_values(meta, stored.unsqueeze(1)).squeeze(1)  # sequences of one option
        torch.testing.assert_close(learned, acted[rows], **EXACT)
        zero = self.learned_values(meta, stored.exclude("meta_hidden", "meta_cell").unsqueeze(1)).squeeze(1)
        later = ~stored["is_init"].squeeze(-1)
        assert not torch.isclose(zero, acted[rows])[later].all(-1).any()

    @pytest.mark.parametrize("network", NETWORKS)
    @pytest.mark.parametrize("name", ["dqn", "hdqn"])
    def test_without_memory(self, name, network):
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            algorithm, steps = self.collected(name, network)
        sub = algorithm.policy if name == "dqn" else algorithm.policy.sub_controller
        learner = algorithm.learners["flat" if name == "dqn" else "sub"]
        steps = greedy(algorithm, steps)
        assert (self.learned_values(sub, learner.extract(steps)).argmax(-1) == steps["action"]).all()

    @pytest.mark.parametrize("network", NETWORKS)
    @pytest.mark.parametrize(
        ("name", "options"),
        [
            ("v1", {}),
            ("v2", {}),
            ("v2", {"meta_input": "cell"}),
            ("v2", {"meta_input": "both"}),
            ("v2", {"meta_input_time": "after_last_observation"}),
        ],
        ids=str,
    )
    def test_meta(self, name, network, options):
        algorithm, steps = self.collected(name, network, max_option_steps=2, **options)
        meta = algorithm.policy.meta_controller
        stored, _ = options_of(algorithm.learners["meta"].extract(steps))
        episodes = 0
        for env in steps.unbind(0):
            for traj in env["collector", "traj_ids"].unique():
                played = env[env["collector", "traj_ids"] == traj]
                if played["next", "done"].any():
                    starts = played[played["option_init"].squeeze(-1)]
                    learned = stored[stored["collector", "traj_ids"] == traj]
                    assert len(learned) == len(starts)
                    acted = meta.network.head(starts["next", "meta_hidden"]).detach()
                    torch.testing.assert_close(self.learned_values(meta, learned[None])[0], acted, **EXACT)
                    assert (learned["subgoal"] == starts["subgoal"]).all()
                    episodes += 1
        assert episodes >= 6


def greedy(algorithm, steps):
    """The same steps with the actions that the policy takes without exploration."""
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        acted = algorithm.policy(steps.exclude("next").reshape(-1))["action"]
    return steps.set("action", acted.view(steps.shape))


class TestLastObservation:
    """v2 with ``meta_input_time="after_last_observation"``."""

    def test_the_meta_controller_reads_one_observation_more(self):
        torch.manual_seed(0)
        env = small_env(4)
        algorithm = build("v2", env, max_option_steps=3, meta_input_time="after_last_observation")
        steps = torch.cat(collect(algorithm, env, 8, batches=3), 1)
        sub = algorithm.policy.sub_controller
        starts = (steps["option_init"] & ~steps["is_init"]).squeeze(-1)[:, 1:]
        before, at = steps[:, :-1]["next"][starts], steps[:, 1:][starts]
        with torch.no_grad():
            _, (hidden, cell) = sub.network.step(
                at["observation"], before["active_subgoal"], (before["sub_hidden"], before["sub_cell"])
            )
        torch.testing.assert_close(at["sub_hidden"], hidden)
        torch.testing.assert_close(at["sub_cell"], cell)
        inside = ~steps["option_init"].squeeze(-1)[:, 1:]
        assert (steps["sub_hidden"][:, 1:] == steps["next", "sub_hidden"][:, :-1])[inside].all()

    def test_it_does_not_move_the_state_at_the_start_of_an_episode(self):
        torch.manual_seed(0)
        env = small_env(4)
        algorithm = build("v2", env, meta_input_time="after_last_observation")
        steps = collect(algorithm, env, 20)[0]
        assert not steps["sub_hidden"][steps["is_init"].squeeze(-1)].any()

    def test_what_an_option_led_to_is_what_the_next_one_reads_and_a_cut_episode_ends_with_it_too(self):
        torch.manual_seed(0)
        env = small_env(4)
        algorithm = build("v2", env, max_option_steps=2, meta_input_time="after_last_observation")
        steps = collect(algorithm, env, 30)[0]
        rows = algorithm.learners["meta"].extract(steps)
        starts = steps[steps["option_init"].squeeze(-1)]
        final = (rows["next", "done"] & ~rows["next", "terminated"]).squeeze(-1)
        read = {tuple(row.tolist()) for row in starts["sub_hidden"]}
        assert all(tuple(row.tolist()) in read for row in rows["sub_hidden"][~final])
        cut = steps[(steps["next", "done"] & ~steps["next", "terminated"]).squeeze(-1)]["next"]
        with torch.no_grad():
            hidden, _ = algorithm.policy.sub_controller.advance(cut)
        found = rows["sub_hidden"][final]
        assert len(found) > 2 and ((found[:, None] - hidden[None]).abs().amax(-1) < 1e-6).any(1).all()


@pytest.mark.slow
def test_epsilon_reaches_the_workers_with_the_weights():
    env = small_env(2)
    algorithm = build("drqn", env, exploration=EpsilonGreedy(1.0, 0.0, anneal_frames=10))
    make_transforms = algorithm.make_transforms  # not the algorithm: its replay memory stays in this process
    collector = MultiSyncCollector(
        [lambda: TransformedEnv(small_env(2), make_transforms())] * 2,
        algorithm.policy,
        frames_per_batch=400,
        total_frames=-1,
        auto_register_policy_transforms=False,
    )
    try:
        batches = iter(collector)

        def greedy_share():
            batch = next(batches).flatten(0, 1)
            acted = algorithm.policy.network.head(batch["next", "sub_hidden"]).argmax(-1)
            return (acted == batch["action"]).float().mean().item()

        assert greedy_share() == pytest.approx(0.25, abs=0.1)
        algorithm.explorations["flat"].step(10)
        collector.update_policy_weights_(algorithm.policy)
        next(batches)
        assert greedy_share() == 1.0
    finally:
        collector.shutdown()


class TestMiddleController:
    """A controller between two others: it reads a subgoal, and its memory restarts where that was chosen."""

    def make(self):
        names = {"condition_key": "goal", "init_key": "goal_init", "mask_key": None}
        return MetaController(make_network(num_conditions=2), input_keys=["observation"], **names)

    def test_its_state_restarts_where_the_level_above_chose_and_is_kept_where_it_is_not_its_turn(self):
        meta = self.make()
        gate, init = torch.tensor([[True], [True], [False]]), torch.tensor([[False], [True], [False]])
        td = root(option_init=gate, goal=torch.tensor([0, 1, 1]), goal_init=init)
        zeroed = td.clone()
        for key in ("meta_hidden", "meta_cell"):
            zeroed[key][1] = 0.0
        found, expected = meta(td.clone())["next"], meta(zeroed.clone())["next"]
        for key in ("meta_hidden", "meta_cell"):
            torch.testing.assert_close(found[key], expected[key])
            assert torch.equal(found[key][2], td[key][2]) and (found[key][:2] != td[key][:2]).any(-1).all()

    def test_what_it_is_told_changes_what_it_learns(self):
        meta = self.make()
        sequence = {"observation": torch.randn(1, 4, 2), "goal_init": torch.zeros(1, 4, 1, dtype=torch.bool)}
        values = []
        for goal in (0, 1):
            td = TensorDict({**sequence, "goal": torch.full((1, 4), goal)}, [1, 4])
            with set_recurrent_mode(True):
                values.append(meta(td)["subgoal_value"])
        assert (values[0] != values[1]).any(-1).all()

    @pytest.mark.parametrize("names", [{}, {"condition_key": "goal"}, {"init_key": "goal_init"}], ids=str)
    def test_condition_and_restart_belong_together(self, names):
        with pytest.raises(ValueError, match="condition_key and init_key must be None exactly when the network has no"):
            MetaController(make_network(num_conditions=2), **names)
