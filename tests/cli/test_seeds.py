"""``train.py seeds=...``: several trainings in one process."""

import json
import os
import re
import signal

import pytest
from helpers import check_same, table
from omegaconf import OmegaConf
from processes import run_script, start_script
from programs import TINY, TINY_HDRQN

from hdrqn_torchrl.runs.settings.arguments import SettingsError
from hdrqn_torchrl.runs.settings.seeds import check_together, read_seeds

QUICK = [
    *TINY, "total_frames=640", "log_frames=128", "evaluation.interval_frames=100_000", "checkpoint.interval_frames=256",
    "evaluation.ceilings=false", "logger=csv", *TINY_HDRQN,
]  # fmt: skip
SEEDS = ("3", "4")


class TestSetting:
    def test_a_range_includes_both_ends(self):
        assert read_seeds("0..9") == list(range(10)) and read_seeds("5..5") == [5] and read_seeds([2, 0]) == [2, 0]

    @pytest.mark.parametrize("seeds", ["9..0", "0..", "0-9", [], [1, 1], [-1], [True], ["1"], 3, "0..99999999"])
    def test_anything_else_is_refused(self, seeds):
        with pytest.raises(
            SettingsError, match=r"seeds must be A\.\.B with A <= B, or a list of different numbers, got"
        ):
            read_seeds(seeds)

    def test_a_service_that_follows_one_training_is_refused(self):
        loggers = {"loggers": [{"_target_": "hdrqn_torchrl.runs.logging.make_wandb_logger"}]}
        with pytest.raises(SettingsError, match=r"logger must be csv or tensorboard with seeds, got hdrqn.*wandb"):
            check_together("0..1", loggers, None)

    def test_one_run_to_resume_is_refused(self):
        with pytest.raises(SettingsError, match="resume must be auto or null with seeds, got 'old'; auto goes on"):
            check_together("0..1", {"loggers": []}, "old")
        check_together("0..1", {"loggers": []}, "auto")


@pytest.fixture(scope="module")
def alone(tmp_path_factory):
    folder = tmp_path_factory.mktemp("alone")
    for seed in SEEDS:
        code, _, told = run_script(folder, *QUICK, f"seed={seed}", f"hydra.run.dir=run-seed{seed}")
        assert code == 0, told
    return folder


class TestTraining:
    def test_each_has_a_folder_as_if_it_were_alone(self, alone, tmp_path):
        code, printed, told = run_script(tmp_path, *QUICK, "seeds=3..4", "hydra.run.dir=run-seed0")
        assert code == 0, told
        assert sorted(path.name for path in tmp_path.iterdir() if path.is_dir()) == ["run-seed3", "run-seed4"]
        for seed in SEEDS:
            own, other = tmp_path / f"run-seed{seed}", alone / f"run-seed{seed}"
            check_same(own, other)
            assert {path.name for path in own.iterdir()} == {path.name for path in other.iterdir()}
            assert OmegaConf.load(own / "config.yaml") == OmegaConf.load(other / "config.yaml")
        assert [json.loads(line)["run"] for line in printed.splitlines()] == [
            str(tmp_path / f"run-seed{seed}") for seed in SEEDS
        ]
        shown = [line[:6] for line in told.splitlines() if " frames " in line]
        assert len(shown) >= 4 and set(shown) == {"seed 3", "seed 4"}

    def test_ctrl_c_saves_all_and_the_same_command_goes_on(self, alone, tmp_path):
        command = [*QUICK, "seeds=[3,4]", "hydra.run.dir=run", "resume=auto"]
        process = start_script(tmp_path, *command)
        folders = [tmp_path / "run" / f"seed{seed}" for seed in SEEDS]
        while process.is_alive() and not all(
            (each / "metrics.csv").exists() and len(table(each)) > 2 for each in folders
        ):
            process.join(0.01)
        os.kill(process.pid, signal.SIGINT)
        process.join(60)
        told = (tmp_path / "stderr.txt").read_text()
        assert process.exitcode == 130, told
        resumed = re.findall(r"seed (\d): `.* resume=(\S+)` goes on", told)
        assert resumed == [(seed, str(folder)) for seed, folder in zip(SEEDS, folders, strict=True)]
        code, _, told = run_script(tmp_path, *command)
        assert code == 0, told
        for seed, folder in zip(SEEDS, folders, strict=True):
            check_same(folder, alone / f"run-seed{seed}")

    def test_a_wrong_setting_is_told_once(self, tmp_path):
        code, _, told = run_script(tmp_path, *QUICK, "seeds=0..3", "env.view=4", "hydra.run.dir=run")
        assert code == 1 and "Traceback" not in told and told.count("env.view must be") == 1
