"""Parts of a page that a program writes, between marks; the rest is the author's."""

from __future__ import annotations

from hdrqn_torchrl.runs.settings.arguments import SettingsError


def part_of(text: str, mark: str) -> str:
    """What stands between a pair of marks; nothing if they are not there.

    Examples:
        >>> part_of("before <!-- a -->\\nold\\n<!-- end of a --> after", "a")
        'old'
    """
    begin, end = f"<!-- {mark} -->\n", f"\n<!-- end of {mark} -->"
    return text.partition(begin)[2].partition(end)[0] if begin in text and end in text else ""


def put(text: str, mark: str, part: str) -> str:
    """Replaces the text between a pair of marks, or adds text and marks at the end.

    Args:
        text: of the page.
        mark: name of the part.
        part: what it is to hold.

    Raises:
        SettingsError: if one of the marks is missing, or there more than once: what is between could be anybody's.

    Examples:
        >>> put("before <!-- a -->\\nold\\n<!-- end of a --> after", "a", "new")
        'before <!-- a -->\\nnew\\n<!-- end of a --> after'
    """
    begin, end = f"<!-- {mark} -->", f"<!-- end of {mark} -->"
    marked, numbers = f"{begin}\n{part}\n{end}", (text.count(begin), text.count(end))
    if numbers == (0, 0):
        return f"{text.rstrip()}\n\n{marked}\n"
    if numbers != (1, 1) or text.index(begin) > text.index(end):
        raise SettingsError(
            f"a page must have {begin} once and {end} once, behind it, got {numbers[0]} and {numbers[1]} of them; mend "
            "the marks, or remove them."
        )
    return text.partition(begin)[0] + marked + text.partition(end)[2]
