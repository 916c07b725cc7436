"""What goes on now, for who waits, and how far it is: a bar for each stage but the shortest."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from threading import Timer

from rich.console import Console
from rich.progress import (
    BarColumn,
    Progress,
    Task,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.text import Text

quiet = False
"""Set to True to show no bars in this process."""

DELAY = 0.3
"""Seconds that a stage may last before its bar appears."""

_display: Progress | None = None


class _TimeLeft(TimeRemainingColumn):
    """The time that is left; nothing while that isn't known."""

    def render(self, task: Task) -> Text:
        if task.time_remaining is None:
            return Text()
        return Text.assemble("left: ", super().render(task))


@contextmanager
def stage(name: str, total: float | None = None) -> Iterator[Callable[[float], None]]:
    """Show a bar on stderr once the block has lasted :data:`DELAY` seconds: ``with stage(...)``.

    Yields ``advance(steps)``. A bar without ``total`` only shows that work goes on. Bars appear on
    terminals only, or with the environment variable ``ENVMAP_PROGRESS=1``. Stages may nest.
    """
    global _display
    forced = os.environ.get("ENVMAP_PROGRESS") == "1"
    console = Console(stderr=True, force_terminal=True if forced else None)
    if quiet or not console.is_terminal:
        yield lambda steps: None
        return

    # Rich allows one live display a process: nested stages are rows of the outermost one.
    outermost = _display is None
    display = _display = _display or Progress(
        TextColumn("{task.description}"), BarColumn(),
        TimeElapsedColumn(), _TimeLeft(),
        console=console, transient=True,
    )  # fmt: skip
    task = display.add_task(name, total=total, visible=False)

    def show() -> None:
        display.start()
        display.update(task, visible=True, refresh=True)

    timer = Timer(DELAY, show)
    timer.daemon = True
    timer.start()
    try:
        yield lambda steps: display.advance(task, steps)
    finally:
        timer.cancel()
        timer.join()
        display.remove_task(task)
        if outermost:
            display.stop()
            _display = None
