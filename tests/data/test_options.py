from copy import deepcopy

import pytest
import torch
from helpers import batches_of, options_of, random_play
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer

from hdrqn_torchrl.data import (
    OptionExtractor,
    OptionHistory,
    StepSliceSampler,
    episode_of,
)

SHAPES = [(1, 2), (3, 2), (3, 3), (6, 17), (5, 1), (1, 17)]


class PlainExtractor:
    """The same by a loop over environments and steps; an option is (start step, end step)."""

    def __init__(self):
        self.open, self.held = {}, {}

    def __call__(self, batch):
        released = []
        for n in range(len(batch)):
            flags = (batch["option_init"][n], batch["next", "option_done"][n], batch["next", "done"][n])
            for t, (starts, ends, last) in enumerate(torch.cat(flags, -1).tolist()):
                if starts:
                    self.open[n] = batch[n, t]
                if ends and n in self.open:
                    self.held.setdefault(n, []).append((self.open.pop(n), batch[n, t]))
                if last:
                    released += self.held.pop(n, [])
        return released


def assert_same(options, expected):
    if not expected:
        assert options is None
        return
    options, known = options_of(options, "observation", "subgoal_mask")
    assert options.shape == (len(expected),)
    start, end = (torch.stack(steps) for steps in zip(*expected, strict=True))
    for key in ("observation", "subgoal_mask", "is_init", ("collector", "traj_ids")):
        assert (options[key] == start[key]).all(), key
    for key in ("option_steps", "option_return", "terminated"):
        assert (options["next", key] == end["next", key]).all(), key
    for key in ("observation", "subgoal_mask"):
        assert (options["next", key] == end["next", key])[known].all(), key
    ends = (end["next", "done"] == options["next", "done"]).squeeze(-1)
    last = ~known & ~end["next", "terminated"].squeeze(-1)  # of an episode that was given up
    assert (ends | last).all() and last.sum() <= 6
    assert (options["subgoal"] == end["next", "active_subgoal"]).all()


@pytest.mark.parametrize(("num_envs", "length"), SHAPES)
class TestAgainstPlainLoops:
    def test_options_over_many_batches_agree_with_plain_loops(self, num_envs, length):
        extractor, plain, options = OptionExtractor(), PlainExtractor(), 0
        for batch in batches_of(random_play(num_envs, 102), length):
            expected = plain(batch)
            assert_same(extractor(batch), expected)
            options += len(expected)
        assert options >= 20 * num_envs

    def test_a_first_batch_in_mid_episode_agrees_with_plain_loops(self, num_envs, length):
        steps = random_play(num_envs, 54)
        steps = steps[:, 2:] if num_envs > 1 else steps[:, 1:]
        assert not steps["option_init"][:, 0].all()
        extractor, plain = OptionExtractor(), PlainExtractor()
        for batch in batches_of(steps, length):
            assert_same(extractor(batch), plain(batch))

    def test_a_reset_between_two_batches_agrees_with_plain_loops(self, num_envs, length):
        extractor, plain = OptionExtractor(), PlainExtractor()
        whole = 4 * length if length > 5 else 6 * length + (0 if length > 1 else 2)
        for part in range(3):
            steps = random_play(num_envs, whole, seed=part, first_traj=100 * part)
            for batch in batches_of(steps, length):
                assert_same(extractor(batch), plain(batch))

    def test_a_state_dict_carries_options_in_progress_over(self, num_envs, length):
        extractor, plain = OptionExtractor(), PlainExtractor()
        for batch in batches_of(random_play(num_envs, 51), length):
            successor = OptionExtractor()
            successor.load_state_dict(extractor.state_dict())
            extractor = successor
            assert_same(extractor(batch), plain(batch))


def endless(num_envs, length, *, mean_episode=None, seed=0):
    """Steps ``[N, length]`` with options of one to four steps; episodes end at random, or never."""
    generator = torch.Generator().manual_seed(seed)
    rows = []
    for n in range(num_envs):
        episode, left, age = 0, 0, 0
        for t in range(length):
            starts = left == 0
            left = int(torch.randint(1, 5, (), generator=generator)) if starts else left
            age = age + 1 if not starts else 1
            last = mean_episode is not None and float(torch.rand((), generator=generator)) < 1 / mean_episode
            left = 0 if last else left - 1
            first = t == 0 or bool(rows[-1][5])
            rows.append([1_000 * n + t, 10_000 * n + episode, first, starts, left == 0, last, age])
            episode += last
    observation, traj, init, option_init, option_done, done, age = (
        torch.tensor(rows).view(num_envs, length, -1).unbind(-1)
    )
    td = TensorDict(observation=observation, batch_size=[num_envs, length])
    td["is_init"], td["option_init"] = init.bool().unsqueeze(-1), option_init.bool().unsqueeze(-1)
    td["collector", "traj_ids"] = traj
    td["next"] = TensorDict(observation=observation + 1, active_subgoal=observation % 3, batch_size=[num_envs, length])
    done = done.bool().unsqueeze(-1)
    td["next"].update({"done": done, "terminated": done.clone(), "truncated": torch.zeros_like(done)})
    td["next", "option_done"] = option_done.bool().unsqueeze(-1)
    td["next", "option_steps"] = age.unsqueeze(-1)
    td["next", "option_return"] = torch.rand(num_envs, length, 1, generator=generator)
    return td


class TestEpisodesWithoutEnd:
    @pytest.mark.parametrize("mean_episode", [None, 40, 6])
    @pytest.mark.parametrize(("num_envs", "length", "max_held"), [(1, 3, 1), (3, 7, 4), (4, 50, 3), (2, 1, 9)])
    def test_options_of_an_endless_episode_come_out_once_in_order(self, num_envs, length, max_held, mean_episode):
        steps = endless(num_envs, 200, mean_episode=mean_episode)
        settings = {"input_keys": ["observation"], "mask_key": None}
        pieces, whole = OptionExtractor(max_held=max_held, **settings), OptionExtractor(max_held=10_000, **settings)
        taken, expected = [], []
        for batch in batches_of(steps, length):
            taken += [options for options in [pieces(batch)] if options is not None]
            expected += [options for options in [whole(batch)] if options is not None]
            held = pieces.state_dict()["held"]["observation"] // 1_000
            assert held.bincount(minlength=num_envs).max() <= max_held
        stored = torch.cat(taken)
        taken = torch.cat([*taken, pieces.state_dict()["held"].exclude("environment", "over")])
        expected = torch.cat([*expected, whole.state_dict()["held"].exclude("environment", "over")])
        final = (stored["next", "done"] & ~stored["next", "terminated"]).squeeze(-1)
        assert final.any() or mean_episode == 6
        taken = taken[(~taken["next", "done"] | taken["next", "terminated"]).squeeze(-1)]
        assert len(expected) > 40 * num_envs
        taken["collector", "traj_ids"] = episode_of(taken["collector", "traj_ids"])
        by_start = [options[options["observation"].argsort()] for options in (taken, expected)]
        assert (by_start[0] == by_start[1]).all()  # the same transitions
        for n in range(num_envs):
            own = taken["observation"][taken["observation"] // 1_000 == n]
            assert (own[1:] > own[:-1]).all()
        went_on = (~final & ~stored["next", "terminated"].squeeze(-1)).nonzero().flatten()
        led_to = stored["observation"][went_on] + stored["next", "option_steps"][went_on, 0]
        assert torch.equal(stored["observation"][went_on + 1], led_to)  # at the border of two pieces, too
        assert torch.equal(stored["collector", "traj_ids"][went_on + 1], stored["collector", "traj_ids"][went_on])
        starts = steps["observation"][steps["is_init"].squeeze(-1)]
        assert (taken["is_init"].squeeze(-1) == torch.isin(taken["observation"], starts)).all()

    @pytest.mark.parametrize("carry", [False, True], ids=["", "through its state"])
    def test_a_sequence_does_not_go_from_one_piece_to_the_next(self, carry):
        settings = {"input_keys": ["observation"], "mask_key": None, "max_held": 3}
        extractor = OptionExtractor(**settings)
        sampler = StepSliceSampler(slice_len=4, terminated_key=("next", "terminated"))
        buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(1_000), sampler=sampler, batch_size=4_000)
        for batch in batches_of(endless(1, 300, mean_episode=60), 7):
            if (options := extractor(batch)) is not None:
                buffer.extend(options)
            if carry:
                state = deepcopy(extractor.state_dict())
                extractor = OptionExtractor(**settings)
                extractor.load_state_dict(state)
        final = (buffer[:]["next", "done"] & ~buffer[:]["next", "terminated"]).squeeze(-1)
        assert final.sum() > 20
        drawn = buffer.sample().reshape(-1, 4)
        real, over = drawn["collector", "mask"], drawn["next", "done"].squeeze(-1)
        assert not (over[:, :-1] & real[:, 1:]).any()
        assert not (over & ~drawn["next", "terminated"].squeeze(-1))[:, 0].any()  # nothing could be learned from it

    def test_a_short_episode_comes_out_whole_whatever_the_limit_of_others(self):
        steps = endless(2, 200, mean_episode=6)
        usual, limited = (OptionExtractor(input_keys=["observation"], mask_key=None, max_held=m) for m in (1_000, 30))
        for batch in batches_of(steps, 5):
            first, second = usual(batch), limited(batch)
            assert (first is None) == (second is None) and (first is None or (first == second).all())

    @pytest.mark.parametrize("carry", [False, True], ids=["", "through its state"])
    def test_a_piece_knows_the_history_of_the_option_before_it(self, carry):
        steps, taken = endless(3, 200, mean_episode=60), {}
        for max_held in (2, 10_000):
            settings = {"input_keys": ["observation"], "mask_key": None, "max_held": max_held}
            extractor = OptionExtractor(**settings, history=OptionHistory(5))
            found = []
            for batch in batches_of(steps, 4):
                found += [options for options in [extractor(batch)] if options is not None]
                if carry:
                    state = deepcopy(extractor.state_dict())
                    extractor = OptionExtractor(**settings, history=OptionHistory(5))
                    extractor.load_state_dict(state)
            taken[max_held] = torch.cat(found)
        pieces, whole = taken[2], taken[10_000]
        pieces = pieces[(~pieces["next", "done"] | pieces["next", "terminated"]).squeeze(-1)]
        pieces = pieces[torch.isin(pieces["observation"], whole["observation"])]
        pieces, whole = (options[options["observation"].argsort()] for options in (pieces, whole))
        length = whole["history_steps"]
        assert (pieces["history_steps"] == length).all() and (length > 0).float().mean() > 0.8
        assert (pieces["history_subgoal"] == whole["history_subgoal"])[length.squeeze(-1) > 0].all()
        seen = torch.arange(6) <= length
        assert (pieces["history"] == whole["history"])[seen & (length > 0)].all()

    def test_another_number_of_environments_than_before_is_refused(self):
        extractor = OptionExtractor(input_keys=["observation"], mask_key=None)
        extractor(endless(3, 5))
        with pytest.raises(ValueError, match="batch must hold the same 3 environments as those before, got 2; give"):
            extractor(endless(2, 5))

    def test_max_held_must_be_positive(self):
        with pytest.raises(ValueError, match="max_held must be >= 1 option, got 0; "):
            OptionExtractor(max_held=0)


class TestOptions:
    def extract(self, **settings):
        extractor = OptionExtractor(**settings)
        taken = [extractor(batch) for batch in batches_of(random_play(6, 102), 6)]
        return torch.cat([options for options in taken if options is not None], 0)

    def test_the_outcome_of_an_option_differs_from_its_start(self):
        options, known = options_of(self.extract(), "observation")
        moved = (options["observation"] != options["next", "observation"]).flatten(1).any(-1)[known]
        assert known.any() and moved.float().mean() > 0.7  # an overwritten start would make it 0

    def test_a_truncated_episode_ends_with_a_row_at_which_nothing_was_chosen(self):
        rows = self.extract(state_keys=["extra"])
        after, last = rows["next"], torch.cat([rows["collector", "traj_ids"].diff() != 0, torch.tensor([True])])
        final = (after["done"] & ~after["terminated"]).squeeze(-1)
        assert torch.equal(last, after["done"].squeeze(-1)) and 20 < final.sum() < last.sum()
        assert not rows["is_init"][final].any() and not rows["extra"][final].any()
        assert not after["option_steps"][final].any() and not after["option_return"][final].any()

    def test_no_input_is_stored_twice(self):
        rows = self.extract()
        assert not set(rows.exclude("next").keys(True, True)) & set(rows["next"].keys(True, True))

    def test_episodes_come_out_whole_and_in_one_piece(self):
        options = self.extract()
        traj = options["collector", "traj_ids"]
        assert len(traj.unique_consecutive()) == len(traj.unique())
        first = torch.cat([torch.tensor([True]), traj[1:] != traj[:-1]])
        last = torch.cat([traj[1:] != traj[:-1], torch.tensor([True])])
        assert (options["is_init"].squeeze(-1) == first).all()
        assert (options["next", "done"].squeeze(-1) == last).all()

    def test_every_step_of_the_finished_episodes_belongs_to_one_option(self):
        steps, extractor = random_play(6, 102), OptionExtractor()
        options = extractor(steps)
        finished = sum(
            int(env["next", "done"].squeeze(-1).nonzero().max()) + 1 for env in steps.unbind(0)
        )  # steps up to the last end of an episode
        assert options["next", "option_steps"].sum() == finished

    def test_an_option_keeps_only_the_requested_entries(self):
        options = self.extract(input_keys=["extra"], mask_key=None)
        assert set(options.keys(True, True)) == {
            "extra", "is_init", "subgoal", ("collector", "traj_ids"), ("next", "option_steps"),
            ("next", "option_return"), ("next", "done"), ("next", "terminated"),
        }  # fmt: skip

    def test_recurrent_states_are_kept_only_from_the_start_of_an_option(self):
        extractor, batch = OptionExtractor(input_keys=["observation"], state_keys=["extra"]), random_play(3, 60)
        options, expected = options_of(extractor(batch))[0], PlainExtractor()(batch)
        assert options["extra"].tolist() == [start["extra"].item() for start, _ in expected]
        assert "extra" not in options["next"]

    def test_at_end_changes_only_the_final_rows_of_truncated_episodes(self):
        plain = self.extract(input_keys=["observation"])
        changed = self.extract(at_end=lambda after: after.set("observation", after["observation"] + 1))
        final = (plain["next", "done"] & ~plain["next", "terminated"]).squeeze(-1)
        assert torch.equal(changed["observation"][final], plain["observation"][final] + 1) and final.any()
        assert torch.equal(changed["observation"][~final], plain["observation"][~final])

    def test_reset_forgets_options_and_episodes_in_progress(self):
        steps = random_play(6, 20)
        extractor, plain = OptionExtractor(), PlainExtractor()
        extractor(steps[:, :8])
        extractor.reset()
        for batch in batches_of(steps[:, 8:], 4):
            assert_same(extractor(batch), plain(batch))

    def test_keys_can_be_renamed(self):
        names = ("option_init", "option_done", "option_steps", "option_return", "active_subgoal")
        steps, plain = random_play(4, 30), OptionExtractor()
        renamed = steps.clone()
        for name in names:
            for part in (renamed, renamed["next"]):
                if name in part:
                    part["book", name] = part.pop(name)
        renamed["first"] = renamed.pop("is_init")
        renamed["episode"] = renamed.pop(("collector", "traj_ids"))
        keys = {f"{name}_key": ("book", name) for name in names}
        extractor = OptionExtractor(**keys, init_key="first", traj_key="episode", subgoal_key=("book", "chosen"))
        options, expected = extractor(renamed), plain(steps)
        assert (options["book", "chosen"] == expected["subgoal"]).all()
        assert (options["next", "book", "option_return"] == expected["next", "option_return"]).all()
        assert (options["first"] == expected["is_init"]).all()
