"""Settings read back from run folders."""

import pytest
from run_folders import configure, write_run

from hdrqn_torchrl.cli.configuration import resolved
from hdrqn_torchrl.runs.settings.arguments import SettingsError
from hdrqn_torchrl.runs.settings.reading import read_choices, read_config


@pytest.fixture
def run(tmp_path):
    write_run(tmp_path, weights=False)
    return tmp_path


class TestReadConfig:
    def test_stored_settings_are_read_back(self, run):
        config = read_config(run)
        assert config == resolved(configure())
        assert config.algo["sub"]["learning_rate_frames"] == config.total_frames

    def test_a_run_older_than_the_setting_was_in_single_precision(self, run):
        path = run / "config.yaml"
        path.write_text("".join(line for line in path.read_text().splitlines(True) if "precision" not in line))
        assert read_config(run).precision == "fp32"

    @pytest.mark.parametrize(
        "text",
        ["", "text", "[1, 2]", "3", "env: [", "\x00", "seed: 1", "env: &a [*a]", "{", "a: 1\na: 2\n: :", "- env: 1"],
        ids=repr,
    )
    def test_a_malformed_config_is_refused(self, tmp_path, text):
        write_run(tmp_path, text, weights=False)
        with pytest.raises(SettingsError, match=r"config\.yaml can't be read as the settings of a run: .+"):
            read_config(tmp_path)

    def test_a_config_that_is_not_text_is_refused(self, tmp_path):
        (tmp_path / "config.yaml").write_bytes(b"\xff\xfe\x00\x01")
        with pytest.raises(SettingsError, match=r"config\.yaml can't be read as the settings of a run: .+"):
            read_config(tmp_path)

    def test_a_folder_in_place_of_the_config_is_refused(self, tmp_path):
        (tmp_path / "config.yaml").mkdir()
        with pytest.raises(SettingsError, match=r"run must be the folder of a training"):
            read_config(tmp_path)


@pytest.mark.parametrize(
    "content",
    [None, "", "[]", "3", "{}", '{"choices": 3}', '{"choices": [1]}', '{"choices": null}', "{" * 9, "\xff"],
    ids=repr,
)
def test_unreadable_choices_are_empty(tmp_path, content):
    if content is not None:
        (tmp_path / "run.json").write_text(content)
    assert read_choices(tmp_path) == {}


def test_choices_are_always_strings(tmp_path):
    (tmp_path / "run.json").write_text('{"choices": {"env": {"_target_": "os.system"}, "3": null}}')
    assert read_choices(tmp_path) == {"env": "{'_target_': 'os.system'}", "3": "None"}
