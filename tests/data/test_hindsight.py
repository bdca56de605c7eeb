"""Hindsight at both levels, against hand-written transitions, plain loops, and play for the other subgoals."""

from functools import partial
from itertools import pairwise

import pytest
import torch
from helpers import batches_of, build, collect, options_of, random_play, small_env, tiny_settings
from tensordict import TensorDict
from torchrl.envs import Compose, InitTracker, TransformedEnv

from hdrqn_torchrl import keys
from hdrqn_torchrl.algorithms import make_hdqn, make_hdrqn
from hdrqn_torchrl.data import (
    HindsightOptions,
    OptionExtractor,
    OptionHistory,
    StepSelector,
    episode_of,
    relabel_subgoals,
)
from hdrqn_torchrl.modules import compact_network
from hdrqn_torchrl.transforms import IntrinsicReward, SubgoalTransform

SUB_ROOT = ["observation", "action", "option_init", "subgoal_mask"]
SUB_NEXT = ["observation", "intrinsic_reward", "option_done", "option_terminated", "attained", "hazard"]


def flags(text):
    """``"0 1"`` -> two flags; ``"01 11"`` -> two times two."""
    return torch.tensor([[digit == "1" for digit in word] for word in text.split()])


def sequence(*, pursued, attained, init, done, terminated="", episode_done="", mask, hazard="", above="", reward):
    """One sequence ``[1, T]`` of the sub level; flags are given as the numbers of the steps that have them.

    ``above``: steps that terminate the option of the level above.
    """
    time = len(pursued)

    def at(steps):
        return torch.tensor([[str(step) in steps] for step in range(time)])[None]

    subgoal = torch.tensor([int(g) for g in pursued])[None]
    after = TensorDict(attained=flags(attained)[None], hazard=at(hazard), batch_size=[1, time])
    after.update({"option_done": at(done), "option_terminated": at(terminated), "done": at(episode_done)})
    after.update({"above_done": at(above), "above_terminated": at(above)})
    after.update(
        {"terminated": at(episode_done) & at(terminated), "intrinsic_reward": torch.tensor(reward)[None, :, None]}
    )
    sample = TensorDict(subgoal=subgoal, option_init=at(init), subgoal_mask=flags(mask)[None], batch_size=[1, time])
    sample["extra"] = torch.arange(time)[None]
    return sample.set("next", after)


def shown(row):
    """What hindsight writes, with flags as numbers of steps."""

    def steps(flag):
        return "".join(str(step) for step in flag.flatten().nonzero().flatten().tolist())

    after = row["next"]
    return {
        "pursued": "".join(str(g) for g in row["subgoal"].tolist()),
        "reward": after["intrinsic_reward"].flatten().tolist(),
        "init": steps(row["option_init"]),
        "done": steps(after["option_done"]),
        "terminated": steps(after["option_terminated"]),
        "eligible": steps(row["eligible"]),
    }


# Goal 0 was pursued and reached at step 2, then goal 1, reached at step 4, which ends the episode.
BOTH_REACHED = {
    "pursued": "00011", "attained": "00 00 10 00 01", "mask": "11 11 11 01 01", "hazard": "0",
    "init": "03", "done": "24", "terminated": "24", "episode_done": "4", "reward": [-1.0, 0.0, 1.0, 0.0, 1.0],
}  # fmt: skip
# Goal 1 was pursued and goal 0 attained on the way, at step 1.
ON_THE_WAY = {
    "pursued": "1111", "attained": "00 10 00 01", "mask": "11 11 01 01", "hazard": "2",
    "init": "0", "done": "3", "terminated": "3", "episode_done": "3", "reward": [0.0, -0.5, -1.0, 1.0],
}  # fmt: skip


class TestRelabelSubgoals:
    @pytest.mark.parametrize(
        ("played", "told"),
        [
            # Reaching goal 0 ends nothing for goal 1: it costs, and the recurrent state goes on.
            (
                BOTH_REACHED,
                {"pursued": "11111", "reward": [-1.0, 0.0, -0.5, 0.0, 1.0], "init": "0", "done": "4", "terminated": "4",
                 "eligible": "01234"},
            ),
            # A sequence that begins inside an option, with a state that is not exact.
            (
                BOTH_REACHED | {"init": "3"},
                {"pursued": "11111", "reward": [-1.0, 0.0, -0.5, 0.0, 1.0], "init": "", "done": "4", "terminated": "4",
                 "eligible": "01234"},
            ),
            # Goal 0 ends with its being attained; afterwards it could not be chosen.
            (
                ON_THE_WAY,
                {"pursued": "0000", "reward": [0.0, 1.0, -1.0, -0.5], "init": "023", "done": "123", "terminated": "13",
                 "eligible": "01"},
            ),
            # If it can be attained again, a new option to it starts there.
            (
                ON_THE_WAY | {"mask": "11 11 11 11"},
                {"pursued": "0000", "reward": [0.0, 1.0, -1.0, -0.5], "init": "02", "done": "13", "terminated": "13",
                 "eligible": "0123"},
            ),
            # It had been attained before the sequence.
            (
                ON_THE_WAY | {"mask": "01 01 01 01", "attained": "00 00 00 01", "reward": [0.0, 0.0, -1.0, 1.0]},
                {"pursued": "0000", "reward": [0.0, 0.0, -1.0, -0.5], "init": "0123", "done": "0123", "terminated": "3",
                 "eligible": ""},
            ),
            # It can't be chosen for a while: the option ends there without a reward; another starts when it can again.
            (
                {"pursued": "111111", "attained": "00 00 00 00 00 00", "mask": "11 11 01 01 11 11", "init": "0",
                 "done": "", "reward": [0.0] * 6},
                {"pursued": "000000", "reward": [0.0] * 6, "init": "0234", "done": "123", "terminated": "1",
                 "eligible": "0145"},
            ),
            # The subgoal that was pursued can't be chosen for a while: that ends its option, but none for goal 0.
            (
                {"pursued": "1110", "attained": "00 00 00 00", "mask": "11 11 10 10", "init": "02", "done": "12",
                 "reward": [0.0] * 4},
                {"pursued": "0000", "reward": [0.0] * 4, "init": "0", "done": "", "terminated": "",
                 "eligible": "0123"},
            ),
            # Options cut by a time limit of two steps are cut for goal 1, too, and not terminated.
            (
                {"pursued": "0000", "attained": "00 00 00 00", "mask": "11 11 11 11", "init": "02", "done": "13",
                 "reward": [0.0, 0.0, 0.0, 0.0]},
                {"pursued": "1111", "reward": [0.0, 0.0, 0.0, 0.0], "init": "02", "done": "13", "terminated": "",
                 "eligible": "0123"},
            ),
            # The option of the level above terminated at step 1: that ends one for goal 1, too, which is worth nothing.
            (
                {"pursued": "0000", "attained": "00 00 00 00", "mask": "11 11 11 11", "init": "02", "done": "1",
                 "terminated": "1", "above": "1", "reward": [0.0, 0.0, 0.0, 0.0]},
                {"pursued": "1111", "reward": [0.0, 0.0, 0.0, 0.0], "init": "02", "done": "1", "terminated": "1",
                 "eligible": "0123"},
            ),
            # It does so in the step that attains the pursued subgoal, or loses it.
            (
                {"pursued": "0000", "attained": "00 10 00 00", "mask": "11 11 11 11", "init": "02", "done": "1",
                 "terminated": "1", "above": "1", "reward": [0.0, 1.0, 0.0, 0.0]},
                {"pursued": "1111", "reward": [0.0, -0.5, 0.0, 0.0], "init": "02", "done": "1", "terminated": "1",
                 "eligible": "0123"},
            ),
            (
                {"pursued": "0011", "attained": "00 00 00 00", "mask": "11 11 01 01", "init": "02", "done": "1",
                 "terminated": "1", "above": "1", "reward": [0.0, 0.0, 0.0, 0.0]},
                {"pursued": "1111", "reward": [0.0, 0.0, 0.0, 0.0], "init": "02", "done": "1", "terminated": "1",
                 "eligible": "0123"},
            ),
            # An option whose subgoal was gone lasts one step, but goal 1 was not gone.
            (
                {"pursued": "000", "attained": "00 00 01", "mask": "01 01 01", "init": "012", "done": "012",
                 "terminated": "2", "episode_done": "2", "reward": [0.0, 0.0, -0.5]},
                {"pursued": "111", "reward": [0.0, 0.0, 1.0], "init": "0", "done": "2", "terminated": "2",
                 "eligible": "012"},
            ),
            # The episode is truncated in the step that reaches goal 0: the end of both, terminated for goal 0 only.
            (
                {"pursued": "00", "attained": "00 10", "mask": "11 11", "init": "0", "done": "1", "terminated": "1",
                 "reward": [0.0, 1.0]} | {"episode_done": ""},
                {"pursued": "11", "reward": [0.0, -0.5], "init": "0", "done": "", "terminated": "", "eligible": "01"},
            ),
        ],
    )  # fmt: skip
    def test_a_sequence_is_relabelled_for_the_other_subgoal(self, played, told):
        sample = sequence(**played)
        before = sample.clone()
        upper = {"upper_done_key": "above_done", "upper_terminated_key": "above_terminated"}
        found = relabel_subgoals(sample, 2, rewards=IntrinsicReward(wrong_subgoal=-0.5), **upper)
        assert found.shape == (2, len(played["pursued"]))
        as_it_was = {"terminated": "", **{key: played[key] for key in shown(found[0]) if key in played}}
        assert shown(found[0]) == as_it_was | {"eligible": "".join(map(str, range(len(played["pursued"]))))}
        assert shown(found[1]) == told
        assert (found["extra"] == sample["extra"]).all()
        assert (sample == before).all() and "eligible" not in sample

    def test_a_truncated_episode_ends_for_every_subgoal(self):
        sample = sequence(**BOTH_REACHED)
        sample["next", "terminated"].fill_(False)
        sample["next", "option_terminated"][0, 4] = False
        sample["next", "attained"][0, 4] = torch.tensor([True, False])  # goal 1 was pursued, goal 0 reached
        for done in (False, True):
            sample["next", "done"][0, 4] = sample["next", "option_done"][0, 4] = done
            told = shown(relabel_subgoals(sample, 2)[1])
            assert (told["done"], told["terminated"]) == ("4" if done else "", "")

    def test_a_sequence_of_several_episodes_is_relabelled_episode_by_episode(self):
        """As ``sampling="episode_starts"`` gives them: what was attained in the first can be in the second."""
        first, second = sequence(**ON_THE_WAY), sequence(**ON_THE_WAY)
        told = shown(relabel_subgoals(torch.cat([first, second], 1), 2)[1])
        assert (told["init"], told["done"], told["eligible"]) == ("023467", "123567", "0145")

    def test_three_subgoals_triple_the_sequences(self):
        """Every sequence appears once for each subgoal, counted on from the one it began with."""
        played = {"mask": "111 111", "init": "0", "done": "", "reward": [0.0, 0.0]}
        first = sequence(pursued="11", attained="000 001", **played)
        second = sequence(pursued="20", attained="000 100", **(played | {"init": "01", "done": "0"}))
        found = relabel_subgoals(
            torch.cat([first, second]), 3, rewards=IntrinsicReward(reached=2.0, wrong_subgoal=-0.25)
        )
        assert found.shape == (6, 2)
        assert [shown(row)["pursued"] for row in found] == ["11", "20", "22", "00", "00", "11"]
        assert [shown(row)["reward"][1] for row in found] == [0.0, 0.0, 2.0, 2.0, -0.25, -0.25]
        assert [shown(row)["terminated"] for row in found] == ["", "", "1", "1", "", ""]

    def test_stored_states_are_kept_only_for_the_pursued_subgoal(self):
        sample = sequence(**ON_THE_WAY)
        sample["hidden"] = torch.rand(1, 4, 3)
        kept, told = relabel_subgoals(sample, 2, state_keys=["hidden"])["hidden"]
        assert torch.equal(kept, sample["hidden"][0]) and not told.any()

    def test_steps_that_must_not_be_trained_are_not_trained_for_other_subgoals_either(self):
        sample = sequence(**ON_THE_WAY)
        sample["eligible"] = torch.tensor([True, True, False, True]).view(1, 4, 1)
        found = relabel_subgoals(sample, 2)
        eligible = found["eligible"].squeeze(-1)
        assert eligible.tolist() == [[True, True, False, True], [True, True, False, False]]

    def test_a_step_limit_cuts_for_every_subgoal_even_where_one_is_attained(self):
        sample = sequence(**BOTH_REACHED)
        assert shown(relabel_subgoals(sample, 2)[1])["done"] == "4"
        sample["eligible"] = torch.tensor([True, True, False, True, True]).view(1, 5, 1)
        told = shown(relabel_subgoals(sample, 2)[1])
        assert (told["init"], told["done"], told["terminated"]) == ("03", "24", "4")

    def test_a_single_subgoal_needs_no_relabelling(self):
        played = {"pursued": "00", "attained": "0 1", "mask": "1 1", "init": "0", "done": "1", "terminated": "1"}
        sample = sequence(**played, reward=[0.0, 1.0])
        found = relabel_subgoals(sample, 1)
        assert found["eligible"].all() and (found.exclude("eligible") == sample).all()

    def test_keys_can_be_renamed(self):
        names = ("subgoal", "attained", "hazard", "option_init", "option_done", "option_terminated", "intrinsic_reward")
        sample = sequence(**ON_THE_WAY)
        expected = relabel_subgoals(sample, 2)
        renamed = sample.clone()
        for name in (*names, "subgoal_mask"):
            for part in (renamed, renamed["next"]):
                if name in part:
                    part["book", name] = part.pop(name)
        keys = {f"{name}_key": ("book", name) for name in (*names, "eligible")}
        found = relabel_subgoals(renamed, 2, mask_key=("book", "subgoal_mask"), **keys)
        for name in ("subgoal", "option_init", "eligible"):
            assert (found["book", name] == expected[name]).all()
        for name in ("option_done", "option_terminated", "intrinsic_reward"):
            assert (found["next", "book", name] == expected["next", name]).all()


def play(actions, proposals, **book):
    """Episodes in N worlds; ``proposals`` ``[N, T]`` count where options start."""
    env = TransformedEnv(small_env(len(actions), seed=3), Compose(InitTracker(), SubgoalTransform(2, **book)))
    decisions = zip(actions.unbind(1), proposals.unbind(1), strict=True)

    def policy(td):
        action, subgoal = next(decisions)
        return td.update({"action": action, "subgoal": subgoal})

    steps = env.rollout(actions.shape[1], policy, break_when_any_done=False)
    return steps.set(("collector", "traj_ids"), torch.zeros(steps.shape, dtype=torch.int64))


@pytest.mark.parametrize("book", [{}, {"repeatable": True, "wrong_subgoal_reward": -0.5}], ids=str)
@pytest.mark.parametrize("goal", [0, 1])
def test_relabelling_for_a_subgoal_gives_what_acting_for_it_would_have_recorded(goal, book):
    """The same worlds and the same actions, once as it came and once sent to ``goal`` at every choice."""
    torch.manual_seed(0)
    actions, proposals = torch.randint(4, (64, 30)), torch.randint(2, (64, 30))
    proposals[:, 0] = 1 - goal
    select = StepSelector(root_keys=SUB_ROOT, next_keys=SUB_NEXT, subgoal_key="subgoal")
    rewards = IntrinsicReward(wrong_subgoal=book.get("wrong_subgoal_reward", 0.0))
    played = select(play(actions, proposals, **book))
    told = relabel_subgoals(played, 2, rewards=rewards)[64:]
    acted = select(play(actions, torch.full_like(proposals, goal), **book))
    compared = told["eligible"].squeeze(-1)
    assert torch.equal(compared, acted["subgoal_mask"][..., goal]) and (told["subgoal"] == goal).all()
    assert (played["option_init"] != told["option_init"])[compared].sum() > 40  # relabelling changed something
    for key in ("subgoal", "option_init", *(("next", name) for name in SUB_NEXT)):
        assert torch.equal(told[key][compared], acted[key][compared]), key


class TestSubLearner:
    """Relabelled minibatches in the learner and its loss."""

    def learner(self, name="v2", **settings):
        torch.manual_seed(0)
        env = small_env(8)
        make = {"hdqn": make_hdqn, "v1": partial(make_hdrqn, version="v1"), "v2": make_hdrqn}[name]
        sub = tiny_settings(**({"batch_size": 16} | settings))
        algorithm = make(env, compact_network(8, (8,)), sub=sub, sub_hindsight=True)
        learner = algorithm.learners["sub"]
        for batch in collect(algorithm, env, 10, batches=3):
            learner.store(batch)
        return learner

    @pytest.mark.parametrize("name", ["hdqn", "v1", "v2"])
    @pytest.mark.parametrize("settings", [{}, {"trace_decay": 0.5}, {"slice_len": 1}], ids=str)
    def test_a_minibatch_holds_every_subgoal(self, name, settings):
        learner = self.learner(name, **settings)
        sample = learner.sample()
        assert sample.shape == (32, settings.get("slice_len", 4) + learner.settings.lookahead() + 1)
        assert (sample["subgoal"][16:, 0] == 1 - sample["subgoal"][:16, 0]).all()
        assert learner.update(sample)["loss"] > 0

    def test_steps_whose_subgoal_could_not_be_chosen_do_not_affect_learning(self):
        """Neither directly nor through the state or the targets of other steps; sequences span many episodes here."""
        torch.manual_seed(0)
        env = small_env(8)
        algorithm = build("v2", env, settings=tiny_settings(trace_decay=0.9), sub_hindsight=True)
        learner = algorithm.learners["sub"]
        sample = learner.replay.refresh(learner.extract(collect(algorithm, env, 40)[0]))
        barred = ~sample["eligible"].squeeze(-1)
        assert (barred[:, :-1] & ~barred[:, 1:]).any()  # eligible steps follow
        before = learner.loss(sample)
        changed = sample.clone()
        changed["action"][barred] = (changed["action"][barred] + 1) % 4
        changed["next", "intrinsic_reward"][barred] += 5.0
        changed["observation"][barred] = 1
        assert torch.equal(learner.loss(changed)["loss"], before["loss"]) and before["trained_steps"] < sample.numel()
        changed["eligible"].fill_(True)
        assert learner.loss(changed)["loss"] != before["loss"]

    def test_the_original_sequences_have_the_same_loss_as_without_hindsight(self):
        learner = self.learner()
        sample = learner.sample()
        plain = build("v2", small_env(8), settings=tiny_settings()).learners["sub"]
        plain.network.load_state_dict(learner.network.state_dict())
        plain.loss.load_state_dict(learner.loss.state_dict())
        assert torch.equal(learner.loss(sample[:16])["loss"], plain.loss(sample[:16].exclude("eligible"))["loss"])

    def test_more_entries_are_stored_only_with_hindsight(self):
        env = small_env(4)
        batch = collect(build("v2", env), env, 6)[0]
        keys = [
            set(build("v2", env, sub_hindsight=on).learners["sub"].extract(batch).keys(True, True))
            for on in (False, True)
        ]
        assert keys[1] - keys[0] == {"subgoal_mask", ("next", "attained"), ("next", "hazard")}

    @pytest.mark.parametrize("rewards", [{}, {"wrong_subgoal_reward": -0.5, "hazard_reward": -0.25}], ids=str)
    def test_relabelling_uses_the_rewards_of_the_option_book(self, rewards):
        """Relabelled for the subgoal that was pursued, every reward is the stored one."""
        torch.manual_seed(0)
        env = small_env(8)
        learner = build("v2", env, sub_hindsight=True, **rewards).learners["sub"]
        batch = collect(build("v2", env, **rewards), env, 20)[0]
        steps = learner.extract(batch).reshape(-1, 1)
        wanted = steps["next", "intrinsic_reward"].clone()
        steps["next", "intrinsic_reward"].fill_(9.0)
        steps["subgoal"] = 1 - steps["subgoal"]
        assert torch.equal(learner.replay.refresh(steps)["next", "intrinsic_reward"][len(steps) :], wanted)

    def test_n_step_targets_are_refused(self):
        with pytest.raises(ValueError, match=r"sub\.n_step must be 1 with sub_hindsight=True, got 2: later actions"):
            build("v1", small_env(2), settings=tiny_settings(n_step=2), sub_hindsight=True)


def make_extractor(**settings):
    """What ``make_hdrqn`` builds, with a discount of 0.5."""
    history = settings.pop("history", None)
    hindsight = {"at_start": settings.get("at_end")}
    extractors = [
        OptionExtractor(active_subgoal_key=key, history=None if history is None else OptionHistory(history), **settings)
        for key in ("active_subgoal", "hindsight_subgoal")
    ]
    return HindsightOptions(*extractors, gamma=0.5, **hindsight)


def episode(*, pursued, attained, reward, done="", terminated=True, number=5):
    """Steps ``[1, T]`` of one episode; an option ends where it attains its subgoal, in ``done`` and with the episode.

    The observation of a step is its number; ``mask`` is kept as the transform keeps it.
    """
    time = len(pursued)
    reached, mask, masks = [], torch.ones(len(attained.split()[0]), dtype=torch.bool), []
    for step, each in enumerate(flags(attained)):
        reached.append(bool(each[int(pursued[step])]))
        masks.append(mask)
        mask = mask & ~each
    ends = [hit or str(step) in done or step == time - 1 for step, hit in enumerate(reached)]
    column = lambda values: torch.tensor(values).view(1, time, 1)  # noqa: E731
    last = [step == time - 1 for step in range(time)]
    after = TensorDict(observation=torch.arange(1.0, time + 1).view(1, time, 1), batch_size=[1, time])
    after["active_subgoal"], after["attained"] = torch.tensor([[int(g) for g in pursued]]), flags(attained)[None]
    after["subgoal_mask"] = torch.stack([*masks[1:], mask])[None]
    after.update({"extrinsic_reward": column(reward), "option_done": column(ends), "done": column(last)})
    after.update({"terminated": column([end and terminated for end in last])})
    after["truncated"] = after["done"] & ~after["terminated"]
    steps, collected, book = 0, 0.0, []
    for step in range(time):
        steps, collected = (0, 0.0) if step == 0 or ends[step - 1] else (steps, collected)
        steps, collected = steps + 1, collected + 0.5**steps * reward[step]
        book.append((steps, collected))
    after.update({"option_steps": column([s for s, _ in book]), "option_return": column([c for _, c in book])})
    batch = TensorDict(observation=torch.arange(float(time)).view(1, time, 1), batch_size=[1, time])
    batch.update({"subgoal_mask": torch.stack(masks)[None], "option_init": column([True, *ends[:-1]]), "next": after})
    batch["is_init"] = column([step == 0 for step in range(time)])
    batch["active_subgoal"] = after["active_subgoal"].roll(1, 1)
    batch["collector", "traj_ids"] = torch.full((1, time), number)
    return batch


def listed(options):
    """Options as (episode, from, subgoal, to, return, steps, mask at the start and at the end, end of the episode).

    What terminated options led to is not stored: there both are ``None``.
    """
    bits = lambda mask: "".join(str(int(bit)) for bit in mask.tolist())  # noqa: E731
    options, known = options_of(options, "observation", "subgoal_mask")
    assert torch.equal(known, ~options["next", "terminated"].squeeze(-1))
    return [
        (
            row["collector", "traj_ids"].item(),
            int(row["observation"]),
            row["subgoal"].item(),
            int(row["next", "observation"]) if seen else None,
            row["next", "option_return"].item(),
            row["next", "option_steps"].item(),
            bits(row["subgoal_mask"]),
            bits(row["next", "subgoal_mask"]) if seen else None,
            {(False, False): "", (True, True): "terminated", (True, False): "done"}[
                row["next", "done"].item(), row["next", "terminated"].item()
            ],
        )
        for row, seen in zip(options, known.tolist(), strict=True)
    ]


def stored(options):
    """The same as far as it is stored."""
    return [(*o[:3], None, *o[4:7], None, o[8]) if o[8] == "terminated" else o for o in options]


# (played, the options as they were, as they are relabelled)
EPISODES = {
    "another on the way": (
        {"pursued": "111", "attained": "00 10 01", "reward": [0.0, 1.0, 1.0]},
        [(5, 0, 1, 3, 0.75, 3, "11", "00", "terminated")],
        [(-6, 0, 0, 2, 0.5, 2, "11", "01", ""), (-6, 2, 1, 3, 1.0, 1, "01", "00", "terminated")],
    ),
    "nothing else on the way": (
        {"pursued": "0011", "attained": "00 10 00 01", "reward": [0.0, 1.0, 0.0, 1.0]},
        [(5, 0, 0, 2, 0.5, 2, "11", "01", ""), (5, 2, 1, 4, 0.5, 2, "01", "00", "terminated")],
        [],
    ),
    "nothing at all": (
        {"pursued": "00", "attained": "00 00", "reward": [0.0, 0.25], "terminated": False},
        [(5, 0, 0, 2, 0.125, 2, "11", "11", "done")],
        [],
    ),
    "two others on the way": (
        {"pursued": "222222", "attained": "000 010 000 100 000 001", "reward": [1.0, 1.0, 2.0, 1.0, 4.0, 1.0]},
        [(5, 0, 2, 6, 1 + 0.5 + 0.5 + 0.125 + 0.25 + 0.03125, 6, "111", "000", "terminated")],
        [
            (-6, 0, 1, 2, 1.5, 2, "111", "101", ""),
            (-6, 2, 0, 4, 2.5, 2, "101", "001", ""),
            (-6, 4, 2, 6, 4.5, 2, "001", "000", "terminated"),
        ],
    ),
    "the episode ends on the way": (
        {"pursued": "111", "attained": "00 00 10", "reward": [0.0, 0.0, 1.0], "terminated": False},
        [(5, 0, 1, 3, 0.25, 3, "11", "01", "done")],
        [(-6, 0, 0, 3, 0.25, 3, "11", "01", "done")],
    ),
    "the option ends on the way": (
        {"pursued": "110", "attained": "00 10 00", "reward": [0.0, 1.0, 0.5], "done": "1", "terminated": False},
        [(5, 0, 1, 2, 0.5, 2, "11", "01", ""), (5, 2, 0, 3, 0.5, 1, "01", "01", "done")],
        [(-6, 0, 0, 2, 0.5, 2, "11", "01", ""), (-6, 2, 0, 3, 0.5, 1, "01", "01", "done")],
    ),
    "in the second option": (
        {"pursued": "00222", "attained": "000 100 010 000 001", "reward": [0.0, 1.0, 1.0, 0.0, 1.0]},
        [(5, 0, 0, 2, 0.5, 2, "111", "011", ""), (5, 2, 2, 5, 1.25, 3, "011", "000", "terminated")],
        [
            (-6, 0, 0, 2, 0.5, 2, "111", "011", ""),
            (-6, 2, 1, 3, 1.0, 1, "011", "001", ""),
            (-6, 3, 2, 5, 0.5, 2, "001", "000", "terminated"),
        ],
    ),
    "both in one step": (
        {"pursued": "11", "attained": "00 11", "reward": [0.0, 1.0]},
        [(5, 0, 1, 2, 0.5, 2, "11", "00", "terminated")],
        [],
    ),
    "the first of two in one step": (
        {"pursued": "222", "attained": "000 110 001", "reward": [0.0, 1.0, 1.0]},
        [(5, 0, 2, 3, 0.75, 3, "111", "000", "terminated")],
        [(-6, 0, 0, 2, 0.5, 2, "111", "001", ""), (-6, 2, 2, 3, 1.0, 1, "001", "000", "terminated")],
    ),
    "once more what was attained before": (
        {"pursued": "0111", "attained": "10 00 10 01", "reward": [1.0, 0.0, 0.0, 1.0]},
        [(5, 0, 0, 1, 1.0, 1, "11", "01", ""), (5, 1, 1, 4, 0.25, 3, "01", "00", "terminated")],
        [],
    ),
}


class TestHindsightOptions:
    @pytest.mark.parametrize("length", [1, 2, 3, 6])
    @pytest.mark.parametrize(("played", "as_they_were", "told"), EPISODES.values(), ids=EPISODES)
    def test_an_episode_gives_its_options_and_those_in_hindsight(self, played, as_they_were, told, length):
        """However it is cut into batches."""
        steps = episode(**played)
        batches = steps.split(length, 1)
        extractor, taken = make_extractor(), []
        for batch in batches:
            before = batch.clone()
            taken.append(extractor(batch))
            assert (batch == before).all()
        assert all(options is None for options in taken[:-1])
        assert listed(taken[-1]) == stored(as_they_were + told)

    def test_episodes_of_many_environments_are_relabelled_separately(self):
        """Whichever ends first; and a state carries all that is in progress."""
        names = [name for name, (played, _, _) in EPISODES.items() if len(played["attained"].split()[0]) == 2]
        rows, wanted = [], []
        for shift in range(3):
            row = []
            for name in names[shift:] + names[:shift]:
                (played, real, told), number = EPISODES[name], 10 * shift + len(row)
                row.append(episode(**played, number=number))
                wanted += [(number, *option[1:]) for option in stored(real)]
                wanted += [(-1 - number, *option[1:]) for option in stored(told)]
            rows.append(torch.cat(row, 1))
        extractor, taken = make_extractor(), []
        for batch in torch.cat(rows).split(5, 1):
            successor = make_extractor()
            successor.load_state_dict(extractor.state_dict())
            extractor = successor
            found = extractor(batch)
            taken += [] if found is None else listed(found)
        assert len(names) == 7 and sorted(taken, key=str) == sorted(wanted, key=str)
        episodes = [option[0] for option in taken]
        assert sum(a != b for a, b in pairwise(episodes)) == len(set(episodes)) - 1  # each comes in one piece
        assert extractor.state_dict()["hindsight"]["changed"].numel() <= 3  # finished episodes are forgotten

    def test_a_reset_forgets_episodes_in_progress(self):
        played, real, told = EPISODES["another on the way"]
        extractor = make_extractor()
        extractor(episode(**EPISODES["two others on the way"][0])[:, :3])
        extractor.reset()
        assert listed(extractor(episode(**played))) == stored(real + told)

    def test_an_episode_whose_beginning_is_unknown_is_relabelled_from_the_first_attainment(self):
        """Options from the first attainment on are known; earlier ones are not."""
        played, _, told = EPISODES["two others on the way"]
        options = make_extractor()(episode(**played)[:, 1:])
        assert [row[1:] for row in listed(options)] == [row[1:] for row in stored(told[1:])]

    def test_keys_can_be_renamed(self):
        names = ("option_init", "option_done", "option_steps", "option_return", "active_subgoal")
        others = ("attained", "subgoal_mask", "extrinsic_reward", "is_init")
        steps = episode(**EPISODES["another on the way"][0])
        renamed = steps.clone()
        for name in (*names, *others):
            for part in (renamed, renamed["next"]):
                if name in part:
                    part["book", name] = part.pop(name)
        renamed["episode"] = renamed.pop(("collector", "traj_ids"))
        keys = {f"{name}_key": ("book", name) for name in names} | {"init_key": ("book", "is_init")}
        keys |= {"traj_key": "episode", "mask_key": None, "input_keys": ["observation"]}
        found = HindsightOptions(
            OptionExtractor(**keys),
            OptionExtractor(**(keys | {"active_subgoal_key": ("told", "subgoal")})),
            gamma=0.5,
            attained_key=("book", "attained"),
            extrinsic_reward_key=("book", "extrinsic_reward"),
            mask_key=("book", "subgoal_mask"),
        )(renamed)
        expected = make_extractor()(steps)
        assert torch.equal(found["subgoal"], expected["subgoal"]) and len(found) == 3
        assert torch.equal(found["next", "book", "option_return"], expected["next", "option_return"])
        assert torch.equal(found["observation"], expected["observation"])
        assert torch.equal(found["episode"], expected["collector", "traj_ids"])

    def test_two_extractors_with_the_same_subgoal_key_are_refused(self):
        with pytest.raises(
            ValueError, match=r"active_subgoal_key of retold must differ from .*, got 'active_subgoal' "
        ):
            HindsightOptions(OptionExtractor(), OptionExtractor())


class PlainHindsight:
    """Relabelled options by a loop over environments and steps."""

    def __init__(self, gamma):
        self.gamma, self.open, self.held, self.restarts = gamma, {}, {}, set()

    def __call__(self, batch):
        return [option for n in range(len(batch)) for step in batch[n] for option in self.take(n, step)]

    def take(self, n, step):
        after, pursued = step["next"], step["next", "active_subgoal"].item()
        if step["option_init"] or n in self.restarts:
            self.open[n] = {"start": step, "return": 0.0, "steps": 0}
        option = self.open[n]
        option["return"] += self.gamma ** option["steps"] * after["extrinsic_reward"].item()
        option["steps"] += 1
        attained = [g for g in range(2) if after["attained"][g] and step["subgoal_mask"][g]]
        option["news"] = bool(attained) and pursued not in attained
        self.restarts = self.restarts | {n} if option["news"] else self.restarts - {n}
        if option["news"] or after["option_done"]:
            option |= {"end": step, "subgoal": attained[0] if option["news"] else pursued}
            self.held.setdefault(n, []).append(option)
        if not after["done"]:
            return []
        held = self.held.pop(n)
        return held if any(option["news"] for option in held) else []


@pytest.mark.parametrize(("num_envs", "length"), [(1, 2), (4, 17), (3, 1)])
def test_relabelled_options_of_random_play_agree_with_plain_loops(num_envs, length):
    steps, total = random_play(num_envs, 51), 0
    pursued, retold = OptionExtractor(), OptionExtractor(active_subgoal_key="hindsight_subgoal")
    extractor, as_they_were = HindsightOptions(pursued, retold, gamma=0.99), OptionExtractor()
    plain = PlainHindsight(0.99)
    for batch in batches_of(steps, length):
        options, real, told = extractor(batch), as_they_were(batch), plain(batch)
        if options is None:
            assert real is None and not told
            continue
        assert (options[: len(real)] == real).all()
        found, known = options_of(options[len(real) :], "observation", "subgoal_mask") if told else ([], [])
        assert len(found) == len(told)
        for row, seen, option in zip(found, known, told, strict=True):
            start, end = option["start"], option["end"]
            assert row["collector", "traj_ids"] == -1 - start["collector", "traj_ids"]
            assert row["subgoal"] == option["subgoal"] and row["is_init"] == start["is_init"]
            assert row["next", "option_steps"] == option["steps"]
            assert row["next", "option_return"].item() == pytest.approx(option["return"])
            for key in ("observation", "subgoal_mask"):
                assert torch.equal(row[key], start[key])
                assert not seen or torch.equal(row["next", key], end["next", key])
            for key in ("done", "terminated"):
                assert torch.equal(row["next", key], end["next", key])
        total += len(told)
    assert total >= 3 * num_envs


def told_options(name="v2", **options):
    """An algorithm with hindsight at the meta level, the steps that it collected, and their options in hindsight."""
    torch.manual_seed(0)
    env = small_env(8)
    algorithm = build(name, env, meta_hindsight=True, gamma=0.5, **options)
    steps, extract = collect(algorithm, env, 40)[0], algorithm.learners["meta"].extract
    found = torch.cat([options for options in map(extract, steps.split(7, 1)) if options is not None])
    told = found[found["collector", "traj_ids"] < 0]
    assert len(told) > 20
    return algorithm, steps, told


def places(steps, told):
    """Environment, first and last step of each relabelled option; they come in order, without gaps."""
    number, found = None, []
    for row in told:
        if row["collector", "traj_ids"] != number:
            number = row["collector", "traj_ids"]
            env, time = (steps["collector", "traj_ids"] == -1 - number).nonzero()[0].tolist()
        found.append((env, time, time + row["next", "option_steps"].item() - 1))
        time = found[-1][-1] + 1
    return found


TIMES = ("after_last_decision", "after_last_observation")


class TestMetaInputs:
    @pytest.mark.parametrize("name", ["hdqn", "v1"])
    def test_v1_reads_the_observation(self, name):
        _, steps, told = told_options(name)
        for row, (env, start, end) in zip(told, places(steps, told), strict=True):
            final = end < start  # it shows what the last step led to
            seen = steps["next", "observation"][env, end] if final else steps["observation"][env, start]
            assert torch.equal(row["observation"], seen)

    @pytest.mark.parametrize("meta_input", ["hidden", "cell", "both"])
    @pytest.mark.parametrize("time", TIMES)
    def test_v2_reads_the_state_at_which_the_subgoal_was_attained(self, time, meta_input):
        """As the collected steps hold it."""
        algorithm, steps, told = told_options(meta_input=meta_input, meta_input_time=time)
        network, states = algorithm.policy.sub_controller.network, None
        for row, (env, _, end) in zip(told, places(steps, told), strict=True):
            before = network.initial_state() if row["is_init"] else states
            after = steps["next"][env, end]
            states = after["sub_hidden"], after["sub_cell"]
            if time == "after_last_observation":
                states = network.step(after["observation"], after["active_subgoal"], states)[1]
            for key, start in zip(("sub_hidden", "sub_cell"), before, strict=True):
                assert (key in row) == (meta_input in (key.removeprefix("sub_"), "both"))
                if key in row:
                    torch.testing.assert_close(row[key], start)

    @pytest.mark.parametrize("time", TIMES)
    def test_refreshed_states_are_those_of_a_sub_controller_with_the_relabelled_subgoal(self, time):
        algorithm, steps, told = told_options(meta_input_time=time, refresh_hidden_steps=7)
        network, state, changed = algorithm.policy.sub_controller.network, None, 0
        refreshed = algorithm.learners["meta"].replay.refresh(told.clone().unsqueeze(0)).squeeze(0)
        for row, stored, (env, start, end) in zip(refreshed, told, places(steps, told), strict=True):
            before = network.initial_state(1)[0] if row["is_init"] else state[0]
            seen = steps["observation"][env, start : end + 1]
            if time == "after_last_observation":
                seen = torch.cat([seen, steps["next", "observation"][env, end : end + 1]])
            state = network.initial_state(1)
            for observation in seen:
                _, state = network.step(observation[None], row["subgoal"][None], state)
            torch.testing.assert_close(row["sub_hidden"], before[0])
            changed += bool((row["sub_hidden"] - stored["sub_hidden"]).abs().max() > 1e-4)
        assert changed > 10


class TestMetaLearner:
    @pytest.mark.parametrize("name", ["hdqn", "v1", "v2"])
    def test_a_sequence_is_either_real_or_in_hindsight(self, name):
        """Real or in hindsight, and of one episode."""
        torch.manual_seed(0)
        env = small_env(8)
        settings = tiny_settings(slice_len=3, batch_size=256, capacity=100)  # so that the memory wraps
        algorithm = build(name, env, settings=settings, meta_hindsight=True)
        learner = algorithm.learners["meta"]
        for batch in collect(algorithm, env, 10, batches=8):
            learner.store(batch)
        sample = learner.sample()
        number, valid = sample["collector", "traj_ids"], sample["collector", "mask"]
        assert torch.equal((number == number[:, :1]) | ~valid, torch.ones_like(valid))
        assert 0.1 < (number < 0).float().mean() < 0.9 and (valid.sum(-1) > 1).any() and len(learner.buffer) == 100
        assert learner.update(sample)["loss"] > 0

    def test_without_hindsight_only_real_options_are_stored(self):
        env = small_env(8)
        algorithm = build("v2", env)
        options = algorithm.learners["meta"].extract(collect(algorithm, env, 20)[0])
        assert (options["collector", "traj_ids"] >= 0).all()

    @pytest.mark.parametrize("smdp_discount", [True, False])
    def test_returns_are_discounted_as_in_the_option_book(self, smdp_discount):
        """A goal that an option attains in its second step pays 1 or 0.01."""
        _, _, told = told_options(smdp_discount=smdp_discount)
        second = told["next", "option_steps"] == 2
        returns = {round(value, 6) for value in told["next", "option_return"][second].tolist()} - {0.0}
        assert returns and returns <= ({0.5, 0.005} if smdp_discount else {1.0, 0.01})


@pytest.mark.parametrize(("num_envs", "length"), [(3, 4), (5, 17)])
def test_an_episode_that_comes_out_in_pieces_is_relabelled_in_the_same_way(num_envs, length):
    """Each option on its own, as an episode without end is stored while it goes on."""

    def rows(options):
        columns, options = (("collector", "traj_ids"), "subgoal", "observation"), options_of(options)[0]
        numbers = (("next", "option_steps"), ("next", "option_return"))
        flat = [options[key].reshape(len(options), -1).double() for key in (*columns, *numbers)]
        return {tuple(row) for row in torch.cat(flat, 1).tolist()}

    def number(options):
        own = options["collector", "traj_ids"]
        return options.set(("collector", "traj_ids"), torch.where(own < 0, -1 - episode_of(-1 - own), episode_of(own)))

    told = []
    for max_held in (1, 1_000):
        pursued = OptionExtractor(max_held=max_held)
        retold = OptionExtractor(active_subgoal_key=keys.HINDSIGHT_SUBGOAL, max_held=max_held)
        extractor = HindsightOptions(pursued, retold, gamma=0.9)
        taken = [extractor(batch) for batch in batches_of(random_play(num_envs, 102), length)]
        told.append(rows(number(torch.cat([options for options in taken if options is not None]))))
    pieces, whole = told
    episodes = {row[0] for row in whole}
    pieces = {row for row in pieces if row[0] in episodes}  # others are not over
    assert pieces == whole and sum(row[0] < 0 for row in pieces) > 30
