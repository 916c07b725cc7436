"""Work that only waits, for clusters under test: nothing of Mitsuba is needed."""

from __future__ import annotations

import time
from typing import NamedTuple

from distributed import get_worker


class Outcome(NamedTuple):
    """As ``envmap_integrator.distributed.worker.Outcome``."""

    worker: str
    value: object
    fault: str = ""
    lacks: bool = False


def sleep(value: object, seconds: float) -> Outcome:
    """That value, after a while."""
    time.sleep(seconds)
    return Outcome(get_worker().address, value)


def starve() -> Outcome:
    """Nothing: there isn't enough memory."""
    raise MemoryError("no memory for so many pixels")


def fail(fault: str) -> Outcome:
    """A fault of the worker."""
    return Outcome(get_worker().address, None, fault)
