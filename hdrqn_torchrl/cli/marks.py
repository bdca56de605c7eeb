"""Parts of a page that a program writes, between marks; the rest is the author's."""

from __future__ import annotations

import re


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

    Examples:
        >>> put("before <!-- a -->\\nold\\n<!-- end of a --> after", "a", "new")
        'before <!-- a -->\\nnew\\n<!-- end of a --> after'
    """
    begin, end = f"<!-- {mark} -->", f"<!-- end of {mark} -->"
    marked = f"{begin}\n{part}\n{end}"
    if begin not in text:
        return f"{text.rstrip()}\n\n{marked}\n"
    return re.sub(f"{re.escape(begin)}.*?{re.escape(end)}", lambda _: marked, text, flags=re.DOTALL)
