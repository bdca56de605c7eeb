import math
from pathlib import Path

import pytest

from hdrqn_torchrl.analysis.grouping import Entry, differences, rows_of, task_key, value_of
from hdrqn_torchrl.analysis.results import Run

GRID = {"_target_": "hdrqn_torchrl.envs.MultiGoalGridEnv", "layout": "open", "num_goals": 2, "view": 5, "num_envs": 64}


def entry(name="run", choices=None, env=None, **settings):
    env = GRID | (env or {})
    return Entry(Run(Path("outputs") / name, {}), {"env": env, "seed": 0, **settings}, choices or {})


def labels(entries, *by, **options):
    """Labels of each row, by title."""
    return {row.title: list(row.groups) for row in rows_of(entries, by, **options)}


def test_tasks_of_one_name_are_not_averaged_by_env():
    choices = {"env": "gridworld", "algo": "v2"}
    entries = [entry(choices=choices, env={"view": view}) for view in (3, 5, 5)]
    assert labels(entries, "env") == {"gridworld": ["gridworld, view=3", "gridworld, view=5"]}
    assert labels(entries, "env", "env.view") == {"gridworld": ["gridworld, view=3", "gridworld, view=5"]}
    assert labels(entries[1:], "env") == {"gridworld": ["gridworld"]}


def test_runs_that_were_evaluated_on_other_tasks_are_told():
    plain, other = entry(evaluation={"env": {}}), entry(evaluation={"env": {"layout": "four_rooms"}, "episodes": 3})
    assert differences([plain, other]) == ["evaluation.env.layout"]
    assert differences([plain, entry()]) == []


class TestGroups:
    def test_the_choices_of_the_run_name_the_groups(self):
        first, second, third = (entry(choices={"env": "gridworld", "algo": algo}) for algo in ("v2", "dqn", "v2"))
        (row,) = rows_of([first, second, third])
        assert row.title == "gridworld"
        assert row.groups == {"dqn": [second], "v2": [first, third]}
        assert list(row.groups) == ["dqn", "v2"]

    def test_a_setting_groups_with_its_last_name_and_numbers_sort_by_size(self):
        entries = [entry(algo={"sub": {"slice_len": length}}) for length in (16, 8, 4)]
        assert labels(entries, "algo.sub.slice_len") == {"gridworld": ["slice_len=4", "slice_len=8", "slice_len=16"]}

    def test_several_keys_keep_the_full_name_where_the_last_one_is_not_enough(self):
        entries = [entry(choices={"algo": "v2"}, algo={"sub": {"tau": 0.01}, "meta": {"tau": 0.1}}, seed=3)]
        assert labels(entries, "algo", "algo.sub.tau", "algo.meta.tau", "seed") == {
            "gridworld": ["v2, algo.sub.tau=0.01, algo.meta.tau=0.1, seed=3"]
        }

    def test_runs_without_the_key_are_called_none(self):
        entries = [entry(algo={"gamma": 0.9}), entry(algo={}), entry(algo={"gamma": None})]
        assert labels(entries, "algo.gamma") == {"gridworld": ["gamma=0.9", "gamma=none"]}

    def test_no_keys_put_all_runs_together(self):
        assert labels([entry(), entry()]) == {"gridworld": ["all"]}

    def test_single_runs_are_named_by_the_distinct_part_of_their_folders(self):
        assert labels([entry("sweep/0-dqn"), entry("sweep/1-v2")], "run") == {"gridworld": ["0-dqn", "1-v2"]}
        assert labels([entry("a/seed0"), entry("b/seed0")], "run") == {"gridworld": ["a/seed0", "b/seed0"]}
        assert labels([entry("a/seed0")], "run") == {"gridworld": ["seed0"]}

    @pytest.mark.parametrize("key", ["alog", "algo.sub.slice", "seed.value"])
    def test_a_key_that_no_run_has_is_refused(self, key):
        with pytest.raises(ValueError, match=f"got '{key}', which none of them has"):
            rows_of([entry(algo={"sub": {"slice_len": 8}})], [key])

    def test_a_key_that_holds_several_settings_is_refused(self):
        with pytest.raises(ValueError, match=r"single settings, got 'algo.sub'; name one below it: slice_len, tau"):
            rows_of([entry(algo={"sub": {"slice_len": 8, "tau": 0.1}})], ["algo.sub"])

    def test_runs_without_any_settings_are_still_grouped(self):
        assert labels([Entry(Run(Path("a"), {}))], "algo") == {"unknown task": ["none"]}

    @pytest.mark.parametrize(
        ("settings", "name"),
        [
            ({"_target_": "hdrqn_torchrl.algorithms.make_dqn"}, "dqn"),
            ({"_target_": "hdrqn_torchrl.algorithms.make_drqn", "recurrent": True}, "drqn"),
            ({"_target_": "hdrqn_torchrl.algorithms.make_drqn", "recurrent": False}, "dqn"),
            ({"_target_": "hdrqn_torchrl.algorithms.make_hdrqn", "version": "v2", "recurrent": True}, "v2"),
            ({"_target_": "hdrqn_torchrl.algorithms.make_hdrqn", "version": "v1", "recurrent": False}, "hdqn"),
            ({"_target_": "my_package.make_better"}, "better"),
        ],
    )
    def test_runs_without_recorded_choices_are_named_after_their_builder(self, settings, name):
        assert value_of(entry(algo=settings), "algo") == name

    def test_environment_and_network_are_named_alike(self):
        there = entry(env={"layout": "four_rooms"}, network={"_target_": "hdrqn_torchrl.modules.compact_network"})
        assert (value_of(there, "env"), value_of(there, "network")) == ("four_rooms", "compact")
        assert value_of(entry(env={"layout": ["###", "# #", "###"]}), "env") == "MultiGoalGridEnv"

    @pytest.mark.parametrize(
        ("value", "text"),
        [(None, "none"), (True, "true"), (8, "8"), (1.0, "1"), (1e-5, "1e-05"), (math.inf, "inf"), ([1, 2], "[1, 2]")],
    )
    def test_values_read_as_in_the_settings(self, value, text):
        assert value_of(entry(algo={"gamma": value}), "algo.gamma") == text


class TestTasks:
    def test_tasks_have_rows_with_titles_that_tell_them_apart(self):
        choices = {"env": "gridworld", "algo": "v2"}
        entries = [
            entry(choices=choices, env={"view": 5, "num_goals": 10}),
            entry(choices=choices, env={"view": 5, "num_goals": 2}),
            entry(choices=choices | {"env": "four_rooms"}, env={"layout": "four_rooms"}),
        ]
        assert labels(entries, "algo") == {
            "four_rooms": ["v2"],
            "gridworld, num_goals=2": ["v2"],
            "gridworld, num_goals=10": ["v2"],
        }

    @pytest.mark.parametrize("key", ["num_envs", "seed", "device"])
    def test_settings_that_do_not_change_the_task_do_not_split_it(self, key):
        assert task_key(entry(env={key: 1})) == task_key(entry(env={key: 2}))
        assert len(rows_of([entry(env={key: 1}), entry(env={key: 2})], [])) == 1

    def test_tasks_of_ids_are_called_by_them_whatever_subgoals_agents_are_given(self):
        def run(id, algo, **settings):
            return entry(choices={"env": "gym", "algo": algo}, env={"id": id, "subgoals": None, **settings})

        mine = {"subgoals": "my_package.Mine", "backend": "envpool"}
        entries = [
            run("Key-v0", "drqn"),
            run("Key-v0", "v3", **mine),
            run("Maze-v0", "v3"),
            run("Maze-v0", "v3", max_steps=9),
        ]
        assert labels(entries, "algo") == {
            "Key-v0": ["drqn", "v3"],
            "Maze-v0, max_steps=9": ["v3"],
            "Maze-v0, max_steps=none": ["v3"],
        }
        assert labels(entries[:3], "env") == {"Key-v0 + Maze-v0": ["Key-v0", "Maze-v0"]}
        assert {"env.subgoals", "env.backend"} <= set(differences(entries[:2]))

    def test_subgoals_are_part_of_a_task_without_an_id(self):
        assert task_key(entry(env={"subgoals": ["key"]})) != task_key(entry(env={"subgoals": ["door"]}))

    def test_groups_of_a_setting_of_the_environment_share_their_row(self):
        entries = [entry(env={"view": view, "num_goals": goals}) for view in (3, 5) for goals in (2, 3)]
        assert labels(entries, "env.view") == {
            "gridworld, num_goals=2": ["view=3", "view=5"],
            "gridworld, num_goals=3": ["view=3", "view=5"],
        }

    def test_groups_of_environments_share_one_row(self):
        entries = [entry(env={"layout": layout}) for layout in ("open", "four_rooms")]
        assert labels(entries, "env") == {"gridworld + four_rooms": ["four_rooms", "gridworld"]}

    def test_pooled_tasks_share_one_row_and_their_groups(self):
        choices = {"env": "gridworld", "algo": "v2"}
        entries = [entry(choices=choices, env={"num_goals": goals}) for goals in (2, 3)]
        (row,) = rows_of(entries, pool=True)
        assert (row.title, row.groups) == ("gridworld", {"v2": entries})


def test_differences_are_settings_besides_task_and_seed():
    first = entry(env={"view": 3, "num_envs": 8}, seed=0, device="cpu", total_frames=10, algo={"sub": {"tau": 0.1}})
    second = entry(env={"view": 5, "num_envs": 9}, seed=1, device="auto", total_frames=20, algo={"sub": {"tau": 0.2}})
    assert differences([first, second]) == ["total_frames", "env.num_envs", "algo.sub.tau"]
    assert differences([first, first]) == []
