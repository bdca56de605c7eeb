import re
from pathlib import Path

import torch

PAGE = Path(__file__).parents[1] / "docs/extending.md"


def test_the_code_of_the_page_on_extending_works():
    torch.manual_seed(0)
    names: dict = {}
    for number, code in enumerate(re.findall(r"```python\n(.*?)```", PAGE.read_text(), flags=re.S)):
        exec(compile(code, f"{PAGE.name}, block {number}", "exec"), names)
        if number == 0:  # sticks to random actions, and carries them
            carried = names["steps"]["repeated_action"].squeeze(-1)
            assert (carried > 0).any() and (carried == 0).any()
            assert not carried[names["steps"]["is_init"].squeeze(-1)].any()
    steps, agent = names["steps"], names["agent"]
    assert torch.equal(steps["next", "attained"][..., 1:], steps["next", "hazard"])
    assert agent.monitors["hazards"].count == steps["next", "hazard"].sum() > 0
