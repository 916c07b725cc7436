"""What Mitsuba warns of."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager

import mitsuba as mi

#: What Mitsuba writes ahead of a message: date, time, level, and where it comes from.
_HEAD = re.compile(r"\S+ \S+ [A-Z]+ .*?\] (\w+\(\): |<\w+>: )?")


@contextmanager
def warned() -> Iterator[list[str]]:
    """The warnings that Mitsuba gives in the block, repeated ones too; it still prints them.

    They are messages alone, without date and place.
    """
    heard: list[str] = []

    class Listener(mi.Appender):
        def append(self, level, text):
            if level >= mi.LogLevel.Warn:
                heard.append(_HEAD.sub("", text, count=1))

        def log_progress(self, *progress):
            pass

    listener = Listener()
    mi.logger().add_appender(listener)
    try:
        yield heard
    finally:
        mi.logger().remove_appender(listener)
