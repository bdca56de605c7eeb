import io
from types import SimpleNamespace

import pytest
from helpers import build
from rich.console import Console
from walk import walk

from hdrqn_torchrl.envs import MultiGoalGridEnv
from hdrqn_torchrl.rendering import draw_text, play_in_terminal, record_episodes, terminal


def plain(frame, width=100):
    console = Console(file=io.StringIO(), width=width)
    console.print(draw_text(frame))
    return console.file.getvalue()


def test_text_holds_every_fact():
    text = plain(walk("v2")[2])
    for fact in (
        "episode 1 of 1   step 2 of 9   rᵉˣ 1.00   rⁱⁿ 0.00, this option 0.00",
        "██   x @>2██    x @>2",
        "wants goal 2 just chosen",
        "does → right",
        "goal 1 reached, rᵉˣ +1.00; chooses goal 2",
    ):
        assert fact in text
    lines = text.splitlines()
    assert any("  goal 1 not now" in line and "1.000" in line for line in lines)
    assert any("> goal 2 ████████████████  0.500" in line for line in lines)
    assert any("> → right ████████████████  0.500" in line for line in lines)
    assert any("← left  ████████████░░░░  0.250" in line for line in lines)
    assert any("↓ down  ██████░░░░░░░░░░ -0.125" in line for line in lines)


def test_text_of_a_flat_agent_has_one_level_and_the_total_reward():
    text = plain(walk("drqn")[-1])
    assert "rᵉˣ 2.00   r 1.00" in text and "both goals in order, return 1.00" in text
    assert "wants" not in text and "goal 1 " not in text


def test_a_frame_fits_a_terminal_of_80_by_24():
    env = MultiGoalGridEnv(1, layout="four_rooms", num_goals=3)
    agent = build("v2", env)
    lines = plain(record_episodes(agent.transform(env), agent)[1], width=200).rstrip().splitlines()
    assert len(lines) <= 24 and max(map(len, map(str.rstrip, lines))) <= 80


def test_without_a_terminal_all_frames_are_printed_at_once(monkeypatch):
    monkeypatch.setattr(terminal, "time", SimpleNamespace(sleep=lambda _: pytest.fail("nobody is watching")))
    console = Console(file=io.StringIO(), width=100)
    play_in_terminal(walk("v2"), console)
    text = console.file.getvalue()
    assert [text.count(f"step {step} of 9") for step in range(5)] == [1, 1, 1, 1, 0]
    assert "\x1b" not in text


def test_in_a_terminal_frames_replace_each_other_at_their_pace(monkeypatch):
    pauses = []
    monkeypatch.setattr(terminal, "time", SimpleNamespace(sleep=pauses.append))
    console = Console(file=io.StringIO(), force_terminal=True, width=100, height=40)
    play_in_terminal(walk("v2"), console, fps=4)
    assert pauses == [0.5, 0.25, 0.5, 2.0]
    text = console.file.getvalue()
    assert "step 3 of 9" in text and text.count("\x1b[1A") >= 3 * 10  # goes up and draws anew


def test_fps_out_of_range_is_refused():
    with pytest.raises(ValueError, match=r"fps must lie in \[1, 50\], got 0"):
        play_in_terminal(walk("v2"), fps=0)
