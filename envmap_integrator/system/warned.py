"""What Mitsuba warns of."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import mitsuba as mi


@contextmanager
def warned() -> Iterator[list[str]]:
    """The warnings that Mitsuba gives in the block, repeated ones too; it still prints them."""
    heard: list[str] = []

    class Listener(mi.Appender):
        def append(self, level, text):
            if level >= mi.LogLevel.Warn:
                heard.append(text)

        def log_progress(self, *progress):
            pass

    listener = Listener()
    mi.logger().add_appender(listener)
    try:
        yield heard
    finally:
        mi.logger().remove_appender(listener)
