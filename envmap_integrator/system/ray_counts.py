"""How many rays of each kind are traced: off, and without any effect, unless asked for."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from enum import IntEnum

import drjit as dr
import mitsuba as mi


class Ray(IntEnum):
    """What a ray is traced for.

    PRIMARY     what a sensor or a texel sees; once more for each hidden source passed
    SHADOW      whether a source is visible
    SECONDARY   what a surface reflects, as far as its cube reaches
    UNBOUNDED   what a surface reflects, in full
    RETRACED    what lies beyond a cube, where its map wasn't trusted
    SOURCE      which source lies beyond a cube, in a scene of sources alone
    SURVEY      no light: where surfaces are, and which texels can be reached
    """

    PRIMARY = 0
    SHADOW = 1
    SECONDARY = 2
    UNBOUNDED = 3
    RETRACED = 4
    SOURCE = 5
    SURVEY = 6


_counter: mi.UInt64 | None = None
"""Rays of each kind so far; None while nobody counts."""


@contextmanager
def count_rays() -> Iterator[dict[str, int]]:
    """Count the rays that our integrators trace in the block, pre-passes included.

    The dictionary that it yields holds the number of each kind of :class:`Ray` once the block is
    left, under the kind's name in lower case. Kernels that count are slower and compiled anew.
    Within another such block, the inner one takes the rays to itself.
    """
    global _counter
    outer = _counter
    _counter = counter = dr.zeros(mi.UInt64, len(Ray))
    dr.make_opaque(counter)
    counts: dict[str, int] = {}
    try:
        yield counts
    finally:
        _counter = outer
    names = (kind.name.lower() for kind in Ray)
    counts.update(zip(names, counter.numpy().tolist(), strict=True))


def counting() -> bool:
    """Does anybody count?"""
    return _counter is not None


def count(kind: Ray, ray: mi.Ray3f | mi.DirectionSample3f, active: mi.Bool) -> None:
    """Count one ray of each active lane; ``ray`` tells how many lanes there are."""
    if _counter is not None:
        # A mask that is the same for all lanes has a width of one.
        lanes = active & dr.full(mi.Bool, True, dr.width(ray))
        dr.scatter_add(_counter, mi.UInt64(1), mi.UInt32(int(kind)), lanes, dr.ReduceMode.Local)


def count_secondary(ray: mi.Ray3f, bounded: mi.Bool, active: mi.Bool) -> None:
    """Count the active lanes' rays, each under its own kind."""
    if _counter is not None:
        count(Ray.SECONDARY, ray, active & bounded)
        count(Ray.UNBOUNDED, ray, active & ~bounded)
