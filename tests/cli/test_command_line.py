"""``key=value`` arguments of the programs that look at runs."""

import subprocess
import sys
from dataclasses import dataclass
from typing import Any

import pytest
from omegaconf import MISSING

from hdrqn_torchrl.cli.command_line import command_line
from hdrqn_torchrl.runs.settings.arguments import SettingsError


@dataclass
class Settings:
    """Of a script."""

    run: str = MISSING
    episodes: int = 10
    out: str | None = None
    files: Any = None


def test_who_has_seen_enough_of_the_output_gets_no_traceback():
    """As in ``zoo.py list | head -1``."""
    code = (
        "import dataclasses, sys\n"
        "from hdrqn_torchrl.cli.command_line import command_line\n"
        "Settings = dataclasses.make_dataclass('Settings', [('lines', int, 1)])\n"
        "sys.argv = ['script.py', 'lines=100000']\n"
        "command_line(Settings, '', lambda settings: [print(line) for line in range(settings.lines)])\n"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        process.stdout.readline()
        process.stdout.close()
        told = process.stderr.read()
    assert process.returncode == 1 and told == b""


class TestCommandLine:
    @pytest.fixture
    def call(self, monkeypatch):
        def call(*arguments):
            seen = []
            monkeypatch.setattr("sys.argv", ["script.py", *arguments])
            command_line(Settings, "What it does.\n", seen.append)
            return seen[0]

        return call

    def test_arguments_fill_the_settings(self, call):
        assert call("run=outputs/x") == Settings("outputs/x", 10, None)
        assert call("run=a", "episodes=3", "out=b.gif") == Settings("a", 3, "b.gif")
        assert call("run=outputs/**", "out=*.png") == Settings("outputs/**", 10, "*.png")

    @pytest.mark.parametrize(
        "name",
        ["a #b", "a: b", "{a", "*a", "!a", "&a", "123", "1e3", "null", "true", "~", "-", "a b", "[a", "'a", '"a"',
         "a=b", "${oc.env:HOME}", "a, b", "%a", "@a", "`a", "|", ">", "", "2026-11-27"],
    )  # fmt: skip
    def test_a_name_is_taken_literally(self, call, name):
        settings = call(f"run={name}", f"out={name}", f"files={name}")
        assert settings == Settings(name, 10, name, None if name == "null" else name)

    def test_a_plus_before_a_setting_is_as_in_the_command_of_a_training(self, call):
        assert call("+run=a", "++episodes=3") == Settings("a", 3, None)

    def test_a_setting_that_takes_several_reads_a_list(self, call):
        assert call("run=a", "files=[a,'b #c']").files == ["a", "b #c"]

    @pytest.mark.parametrize("arguments", [["--help"], ["-h"], ["run=a", "--help"]], ids=str)
    def test_help_is_printed_when_asked_for(self, call, capsys, arguments):
        with pytest.raises(SystemExit) as stop:
            call(*arguments)
        assert stop.value.code == 0 and capsys.readouterr().out == "What it does.\n"

    def test_no_argument_at_all_shows_the_help_as_well(self, call, capsys):
        with pytest.raises(SystemExit) as stop:
            call()
        assert stop.value.code == 2 and capsys.readouterr().out == "What it does.\n"

    @pytest.mark.parametrize(
        ("arguments", "message"),
        [
            (["episodes=3"], "error: run must be given: run=...; --help shows all settings."),
            (["run"], "error: an argument must read key=value, got 'run'; --help shows all of them."),
            (["run=a", "-v"], "error: an argument must read key=value, got '-v'; --help shows all of them."),
            (
                ["run=a", "episods=3"],
                "error: Key 'episods' not in 'Settings'; the settings are run, episodes, out",
            ),
            (["run=a", "episodes=many"], "error: Value 'many' of type 'str' could not be converted to Integer; the "),
            (["run=a", "episodes=[1"], "error: "),
        ],
    )
    def test_a_wrong_argument_is_refused(self, call, arguments, message):
        with pytest.raises(SystemExit) as stop:
            call(*arguments)
        assert str(stop.value.code).startswith(message) and "\n" not in stop.value.code

    def test_a_settings_error_during_the_run_ends_it_with_a_message(self, monkeypatch):
        def work(_):
            raise SettingsError("run must be a folder.")

        monkeypatch.setattr("sys.argv", ["script.py", "run=a"])
        with pytest.raises(SystemExit) as stop:
            command_line(Settings, "doc", work)
        assert stop.value.code == "error: run must be a folder."
