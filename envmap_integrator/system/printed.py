"""What objects of Mitsuba print of themselves, by names."""

from __future__ import annotations

import ast
from typing import Any


def printed(item: object) -> dict[str, str]:
    """The parameters, one a line; those of what is nested in the object as ``child.name``.

    Values of the same name, as those of objects in a list, stand side by side.
    """
    found, within = {}, []
    for line in str(item).splitlines()[1:]:
        text = line.strip().rstrip(",")
        name, equals, value = text.partition(" = ")
        if text in ("]", ")"):
            within = within[:-1]
        elif text.endswith(("[", "(")):
            within.append(name.rstrip("[("))
        elif equals:
            key = ".".join([*within, name])
            found[key] = f"{found[key]}, {value}" if key in found else value
    return found


def plain(text: str) -> Any:
    """The number, truth value or list that a text stands for, or else the text."""
    try:
        return ast.literal_eval(text)
    except (ValueError, SyntaxError):
        return text
