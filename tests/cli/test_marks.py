"""Parts of pages between marks."""

import pytest

from hdrqn_torchrl.cli.marks import part_of, put
from hdrqn_torchrl.runs.settings.arguments import SettingsError

BEGIN, END = "<!-- a -->", "<!-- end of a -->"


def test_a_part_is_added_then_replaced_and_the_rest_stays():
    page = put("# Title\n\nmine\n", "a", r"old \1")
    assert page == f"# Title\n\nmine\n\n{BEGIN}\nold \\1\n{END}\n" and part_of(page, "a") == r"old \1"
    again = put(page + "after\n", "a", "new")
    assert again == f"# Title\n\nmine\n\n{BEGIN}\nnew\n{END}\nafter\n" and part_of(again, "b") == ""


@pytest.mark.parametrize(
    "page",
    [f"{BEGIN}\nmine", f"mine {END}", f"{BEGIN}\nmine\n{BEGIN}\nold\n{END}", f"{END} mine {BEGIN}"],
)
def test_damaged_marks_are_named_and_cost_no_text(page):
    with pytest.raises(SettingsError, match=r"a page must have <!-- a --> once and <!-- end of a --> once"):
        put(page, "a", "new")
