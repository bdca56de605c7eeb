"""Maps of the grid tasks."""

from __future__ import annotations

from collections.abc import Sequence

LAYOUTS: dict[str, tuple[str, ...]] = {
    "open": (
        "###########",
        *["#         #"] * 9,
        "###########",
    ),
    "four_rooms": (
        "###########",
        "#    #    #",
        "#    #    #",
        "#         #",
        "#    #    #",
        "### ### ###",
        "#    #    #",
        "#         #",
        "#    #    #",
        "#    #    #",
        "###########",
    ),
    "nine_rooms": (
        "#################",
        "#    #     #    #",
        "#          #    #",
        "#    #          #",
        "#    #     #    #",
        "### ### ##### ###",
        "#    #     #    #",
        "#    #          #",
        "#    #     #    #",
        "#          #    #",
        "#    #     #    #",
        "## ###### #### ##",
        "#    #     #    #",
        "#          #    #",
        "#    #          #",
        "#    #     #    #",
        "#################",
    ),
}
OF_ROOMS = ("nine_rooms",)  # rooms and doors are subgoals, and goals lie in other rooms than the agent's start


def map_rows(layout: str | Sequence[str]) -> tuple[str, ...]:
    """The rows of a map, given by name or as they are.

    Raises:
        ValueError: if there is no such map, or the rows differ in length.
    """
    if isinstance(layout, str):
        if layout not in LAYOUTS:
            raise ValueError(f"layout must be one of {sorted(LAYOUTS)} or the rows of a map, got {layout!r}.")
        return LAYOUTS[layout]
    rows = tuple(layout)
    if not rows or not rows[0] or any(len(row) != len(rows[0]) for row in rows):
        raise ValueError(f"layout must be rows of equal length >= 1, got {list(rows)}; pad the short rows with '#'.")
    return rows
