"""Parts of a page that a program writes, between marks; the rest is the author's."""

from __future__ import annotations

import re


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
