"""Three levels of v1 and v2: who chooses when, what each level reads, and what it learns from."""

import pytest
import torch
from helpers import build, collect, house, tiny_settings
from torchrl.modules import set_recurrent_mode

from hdrqn_torchrl.algorithms import make_hdrqn
from hdrqn_torchrl.modules import EpsilonGreedy, SuccessEpsilonGreedy, compact_network, writing_values

LEVELS = ("sub", "rooms", "meta")


def three_levels(name="v2", **options):
    torch.manual_seed(0)
    env = house(8)
    return build(name, env, levels=3, **options), env


def played(name="v2", steps=60, **options):
    """An algorithm, and one batch of its play with the Q-values of every decision."""
    algorithm, env = three_levels(name, **options)
    with writing_values(algorithm.policy):
        (batch,) = collect(algorithm, env, steps)
    assert batch["next", "option_done"].sum() > 8 and batch["next", "rooms_subgoal_reached"].any()
    return algorithm, batch


class PlainAgent:
    """The cascade for one environment, with plain Python and one network call for each decision.

    It makes the choices that were made, as far as it is its turn to choose, and says by which Q-values.
    """

    def __init__(self, policy, version):
        self.networks = {name: each.network for name, each in zip(reversed(LEVELS), policy.controllers, strict=True)}
        self.version = version
        self.restart()

    def restart(self):
        self.states = {name: network.initial_state(1) for name, network in self.networks.items()}
        self.goal = self.room = None

    def values(self, name, seen, condition=None):
        condition = None if condition is None else condition[None]
        value, self.states[name] = self.networks[name].step(seen, condition, self.states[name])
        return value[0]

    def act(self, step):
        """The goal, the room, and the Q-values of all levels that choose at this step."""
        if step["is_init"]:
            self.restart()
        observation, values = step["observation"][None], {}
        seen = {name: self.states[below][0] for name, below in (("meta", "rooms"), ("rooms", "sub"))}
        if self.version == "v1":
            seen = dict.fromkeys(seen, observation)
        if step["option_init"]:
            values["subgoal_value"], self.goal = self.values("meta", seen["meta"]), step["subgoal"]
            self.states["rooms"] = self.networks["rooms"].initial_state(1)
        if step["rooms_option_init"]:
            values["rooms_subgoal_value"] = self.values("rooms", seen["rooms"], self.goal)
            self.room, self.states["sub"] = step["rooms_subgoal"], self.networks["sub"].initial_state(1)
        values["action_value"] = self.values("sub", observation, self.room)
        return self.goal, self.room, values


@pytest.mark.parametrize("name", ["v1", "v2"])
@torch.no_grad()
def test_the_cascade_agrees_with_plain_loops(name):
    """Who chooses when, from what it reads, with which memory; episodes end at different times."""
    algorithm, batch = played(name)
    compared = dict.fromkeys(("action_value", "rooms_subgoal_value", "subgoal_value"), 0)
    for row in batch:
        agent = PlainAgent(algorithm.policy, name)
        for step in row:
            goal, room, values = agent.act(step)
            assert (goal, room) == (step["subgoal"], step["rooms_subgoal"])
            for key, value in values.items():
                torch.testing.assert_close(value, step[key], atol=1e-5, rtol=1e-4)
                compared[key] += 1
    assert compared["action_value"] > compared["rooms_subgoal_value"] > compared["subgoal_value"] > 8 * 60 // 7


def learned(learner, rows):
    """Q-values of the learning path on sequences ``[B, T]``."""
    network = learner.network
    with torch.no_grad(), set_recurrent_mode(True):
        return network(rows.select(*network.in_keys, strict=False).exclude(*network.state_keys))[
            network.action_value_key
        ]


@pytest.mark.parametrize("name", ["v1", "v2"])
class TestActingAndLearningAgree:
    def test_at_the_sub_level(self, name):
        algorithm, batch = played(name)
        learner = algorithm.learners["sub"]
        values = learned(learner, learner.extract(batch))
        torch.testing.assert_close(values, batch["action_value"], atol=1e-5, rtol=1e-4)

    @pytest.mark.parametrize(("level", "prefix"), [("rooms", "rooms_"), ("meta", "")])
    def test_where_options_began(self, name, level, prefix):
        algorithm, batch = played(name)
        learner = algorithm.learners[level]
        rows = learner.extract(batch)
        for number in rows["collector", "traj_ids"].unique().tolist():
            own = rows[rows["collector", "traj_ids"] == number]
            values = learned(learner, own[None])[0]
            final = (own["next", learner.loss.tensor_keys.done] & (own["next", prefix + "option_steps"] == 0)).flatten()
            began = batch[prefix + "option_init"].squeeze(-1) & (batch["collector", "traj_ids"] == number)
            acted = batch[prefix + "subgoal_value"][began]
            torch.testing.assert_close(values[~final], acted, atol=1e-5, rtol=1e-4)


class TestRows:
    """What the middle level learns from, against the collected steps."""

    def test_they_are_the_options_among_rooms_with_what_the_goal_in_force_paid(self):
        algorithm, batch = played(gamma=0.5, hazard_reward=-0.25, wrong_subgoal_reward=[-0.5, -0.125])
        rows = algorithm.learners["rooms"].extract(batch)
        expected = []
        for row in batch:
            current, options, episode = None, [], 0
            for step in row:
                after = step["next"]
                if step["rooms_option_init"]:
                    current = {"start": step, "paid": 0.0, "steps": 0}
                current["paid"] += 0.5 ** current["steps"] * after["intrinsic_reward"].item()
                current["steps"] += 1
                if after["rooms_option_done"]:
                    options.append(current | {"end": after})
                if after["done"]:
                    expected, options, episode = expected + options, [], episode + 1
        final = (rows["next", "rooms_option_steps"] == 0).flatten()
        rows = rows[~final]
        assert len(rows) == len(expected) > 20 and final.any()
        for row, option in zip(rows, expected, strict=True):
            end = option["end"]
            assert row["next", "rooms_option_return"].item() == pytest.approx(option["paid"], abs=1e-6)
            assert row["next", "rooms_option_steps"].item() == option["steps"]
            assert row["subgoal"] == option["start"]["next", "active_subgoal"]
            assert row["rooms_subgoal"] == end["rooms_active_subgoal"]
            assert row["option_init"] == option["start"]["option_init"]
            assert torch.equal(row["sub_hidden"], option["start"]["sub_hidden"])
            assert row["next", "option_terminated"] == end["option_terminated"]
            truncated = end["done"] & ~end["option_terminated"]  # a final row follows
            assert row["next", "option_done"] == end["option_done"] & ~truncated

    def test_final_rows_show_what_truncated_episodes_ended_with(self):
        algorithm, batch = played()
        for level, prefix in (("rooms", "rooms_"), ("meta", "")):
            rows = algorithm.learners[level].extract(batch)
            ends = batch["next"][batch["next", "truncated"].squeeze(-1)]
            if level == "rooms":
                ends = ends[~ends["option_terminated"].squeeze(-1)]
            final = rows[(rows["next", prefix + "option_steps"] == 0).flatten()]
            hidden = "sub_hidden" if level == "rooms" else "rooms_hidden"
            assert len(final) == len(ends) > 0 and torch.equal(final[hidden], ends[hidden])


def test_targets_of_three_levels_by_hand():
    """Discount 0.5; every target network says 8, so that only rewards, steps and ends tell targets apart."""
    algorithm, batch = played(gamma=0.5, settings=tiny_settings(max_target="unbounded", burn_in=0.0))
    counted = {}
    for level, learner in algorithm.learners.items():
        with torch.no_grad():
            streams = learner.loss.target_value_network_params["network", "head", "streams"]
            for parameter in streams.values():
                parameter.zero_()
            streams["bias"][0] = 8.0
        stored, k = learner.extract(batch), learner.loss.tensor_keys
        pairs = torch.stack([stored[..., :-1], stored[..., 1:]], -1).reshape(-1, 2)
        pairs = pairs[pairs["collector", "traj_ids"][:, 0] == pairs["collector", "traj_ids"][:, 1]]
        after = pairs["next"][:, 0]
        cut = (after[k.done] & ~after[k.terminated]).flatten()
        goes_on = pairs[~cut & ~after[k.terminated].flatten()]
        ended = goes_on.clone()
        ended["next", k.terminated][:, 0] = ended["next", k.done][:, 0] = True
        reward = goes_on["next", k.reward][:, 0].flatten()
        lasted = 1.0 if k.steps is None else goes_on["next", k.steps][:, 0].flatten()
        for sample, wanted in ((goes_on, reward + 0.5**lasted * 8.0), (ended, reward)):
            result = learner.loss(sample)
            assert result["trained_steps"] == len(sample) > 5, level
            assert result["target"].item() == pytest.approx(wanted.mean().item(), abs=1e-4), level
        assert learner.loss(pairs[cut])["trained_steps"] == 0
        counted[level] = int(cut.sum())
    after = batch["next"]
    from_above = after["option_terminated"] & ~after["rooms_subgoal_reached"] & ~after["terminated"]
    assert from_above.sum() > 5 and after["rooms_option_terminated"][from_above].all()
    assert counted["sub"] == 0  # nothing is left out because of what it attained


@pytest.mark.parametrize(
    ("name", "settings"),
    [
        ("v2", {}),
        ("v2", {"priority_exponent": 0.9, "slice_len": 2}),
        ("v2", {"sampling": "whole_episodes"}),
        ("v2", {"trace_decay": 0.5}),
        ("v2", {"n_step": 2}),
        ("v1", {"sampling": "whole_episodes"}),
        ("v1", {"trace_decay": 0.5}),
        ("hdqn", {}),
        ("hdqn", {"n_step": 2}),
    ],
    ids=str,
)
def test_all_levels_learn(name, settings):
    if name == "hdqn":
        settings = {"slice_len": 2} | settings
    algorithm, env = three_levels(name, settings=tiny_settings(**settings))
    for batch in collect(algorithm, env, 20, batches=4):
        algorithm.observe(batch)
    assert list(algorithm.learners) == list(algorithm.explorations) == list(LEVELS)
    for learner in algorithm.learners.values():
        before = [each.clone() for each in learner.network.parameters()]
        for _ in range(5):
            assert learner.learn()["loss"].isfinite()
        assert any((new != old).any() for new, old in zip(learner.network.parameters(), before, strict=True))


def test_hindsight_and_refreshed_states_work_at_the_lowest_levels():
    algorithm, env = three_levels(sub_hindsight=True, refresh_hidden_steps=10)
    for batch in collect(algorithm, env, 20, batches=4):
        algorithm.observe(batch)
    sample = algorithm.learners["sub"].sample()
    assert len(sample) == 4 * algorithm.learners["sub"].network.network.num_conditions
    for learner in algorithm.learners.values():
        assert learner.learn()["loss"].isfinite()
    assert algorithm.learners["rooms"].replay.refresh is not None and algorithm.learners["meta"].replay.refresh is None


@pytest.mark.parametrize("name", ["hdqn", "v1", "v2"])
def test_in_hindsight_options_of_a_goal_end_those_of_every_room_even_where_they_attain_theirs(name):
    algorithm, batch = played(name, sub_hindsight=True)
    learner = algorithm.learners["sub"]
    steps = learner.extract(batch)
    over, pursued = steps["next", "option_done"], steps["rooms_subgoal"].unsqueeze(-1)
    assert (steps["next", "option_terminated"] & ~steps["next", "terminated"]).sum() > 2
    steps["next", "rooms_attained"] |= over & (torch.arange(steps["next", "rooms_attained"].shape[-1]) == pursued)
    told = learner.replay.refresh(steps)["next"]
    several = len(told) // len(over)
    assert several > 1 and (told["rooms_option_done"] | ~over.repeat(several, 1, 1)).all()
    terminated = steps["next", "option_terminated"].repeat(several, 1, 1)
    assert (told["rooms_option_terminated"] | ~terminated).all()


class Told(EpsilonGreedy):
    """Remembers where it is told that what it goes along with begins."""

    def forward(self, values, *, starts=None, **given):
        self.__dict__.setdefault("starts", []).append(starts)
        return super().forward(values, starts=starts, **given)


@pytest.mark.parametrize("name", ["v1", "v2", "v3"])
def test_a_middle_exploration_is_told_where_options_of_the_level_above_begin(name):
    algorithm, env = three_levels(name, middle_exploration=Told(1.0))
    (batch,) = collect(algorithm, env, 20)
    told = torch.stack(algorithm.explorations["rooms"].starts[1:21], 1)  # the collector tries the policy first
    assert torch.equal(told, batch["option_init"].squeeze(-1)) and told[:, 1:].any()


@pytest.mark.parametrize("name", ["hdqn", "v1", "v2", "v3"])
def test_success_is_that_of_the_options_which_a_level_pursues(name):
    names = ("sub_exploration", "middle_exploration")
    algorithm, env = three_levels(name, **{each: SuccessEpsilonGreedy() for each in names})
    (batch,) = collect(algorithm, env, 60)
    algorithm.observe(batch)
    after = batch["next"].apply(lambda column: column.squeeze(-1) if column.shape[-1:] == (1,) else column)
    cut = after["option_done"] & ~after["rooms_subgoal_reached"] & ~after["done"]  # by the end of the farther option
    assert cut.any()
    for level, prefix in (("sub", "rooms_"), ("rooms", "")):
        done = after[f"{prefix}option_done"] & ~(cut if prefix else torch.zeros_like(cut))
        success = algorithm.explorations[level].success
        ended = batch["next", f"{prefix}active_subgoal"][done].bincount(minlength=len(success.options))
        assert done.any() and success.options.tolist() == ended.tolist()


class TestSettings:
    def test_middle_levels_have_their_own(self):
        middle = tiny_settings(slice_len=3, learning_rate=0.02)
        exploration = EpsilonGreedy(0.5, 0.5)
        algorithm, _ = three_levels(middle=middle, middle_exploration=exploration)
        assert algorithm.learners["rooms"].settings is middle
        assert algorithm.explorations["rooms"].epsilon == 0.5 and algorithm.explorations["rooms"] is not exploration
        assert algorithm.learners["meta"].settings.slice_len == 4

    @pytest.mark.parametrize(
        ("options", "message"),
        [
            ({"levels": 1}, "levels must be >= 2, got 1; use make_drqn"),
            ({"levels": 4}, "levels must be <= 3, got 4: the task states 2 sets"),
            ({"meta_hindsight": True}, "meta_hindsight must be False with levels=3, got True"),
            ({"meta_input_time": "after_last_observation"}, "meta_input_time must be 'after_last_decision' with le"),
            ({"wrong_subgoal_reward": [0.0] * 3}, "wrong_subgoal_reward must be one number, or one for each of 2 sets"),
        ],
    )
    def test_what_does_not_fit_is_refused(self, options, message):
        with pytest.raises(ValueError, match=message):
            make_hdrqn(house(2), compact_network(8, (8,)), **({"levels": 3} | options))
