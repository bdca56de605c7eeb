from hdrqn_torchrl.analysis.gallery import gallery, row, section
from hdrqn_torchrl.runs.cards import Card

FACTS = {"task": "gridworld", "algo": "v3", "command": "hdrqn train seed=1", "commit": "5c31353fb4", "seed": 1}
MEASURED = {"frames": 200_192, "half": True, "episodes": 500, "worlds_seed": 7}
FIGURES = {"return_mean": 1.9, "success_rate": 0.924, "steps_mean": 22.244}
INTERVALS = {"return_mean": [1.8673, 1.9327], "success_rate": [0.8972, 0.9457], "steps_mean": None}
CARD = Card(name="short", figures=FIGURES, intervals=INTERVALS, **FACTS, **MEASURED)


def test_a_row_has_what_a_card_says_and_intervals_where_episodes_differ():
    assert row(CARD) == (
        "| [short](#short) | gridworld | v3 | 200k | 1 | 5c31353 | 1.9 (1.867 to 1.933) | 92.4% (89.7% to 94.6%) "
        "| 22.2 | 500 |"
    )


def test_a_figure_that_a_task_does_not_have_leaves_its_cell_empty():
    card = Card(name="pole", figures={"return_mean": 500.0}, intervals={"return_mean": None}, **FACTS, **MEASURED)
    assert row(card) == "| [pole](#pole) | gridworld | v3 | 200k | 1 | 5c31353 | 500 |  |  | 500 |"


def test_a_section_shows_play_and_command():
    assert section(CARD, "../zoo") == (
        "### short\n\n![Greedy play of short](../zoo/short/play.gif)\n\n```text\nhdrqn train seed=1\n```"
    )


def test_a_gallery_is_a_table_of_all_agents_then_a_section_for_each():
    parts = gallery([CARD, CARD], "zoo").split("\n\n")
    assert len(parts[0].splitlines()) == 4 and parts[0].splitlines()[2] == row(CARD)
    assert "\n\n".join(parts[1:]) == "\n\n".join([section(CARD, "zoo")] * 2)
