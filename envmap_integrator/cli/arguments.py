"""Types of command line arguments."""

from __future__ import annotations

import argparse


def parse_assignment(text: str) -> tuple[str, str]:
    """Split ``key=value`` (an :mod:`argparse` type)."""
    key, separator, value = text.partition("=")
    if not (key and separator):
        raise argparse.ArgumentTypeError(f'expected KEY=VALUE, got "{text}"')
    return key, value


def parse_setting(text: str) -> tuple[str, bool | int | float | str]:
    """Split ``key=value``; spelling decides the type: ``true``, ``3``, ``0.5``, else a string."""
    key, value = parse_assignment(text)
    if value in ("true", "false"):
        return key, value == "true"
    for number in (int, float):
        try:
            return key, number(value)
        except ValueError:
            continue
    return key, value
