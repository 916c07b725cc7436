"""Kernels that are recorded once, and launched again for other data."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from typing import TypeVar

import drjit as dr
import mitsuba as mi

from .interrupt import was_interrupted
from .ray_counts import counting

#: Keys of which recordings are kept, and how many of each.
MOST_KEYS, MOST_RECORDINGS = 16, 4

Result = TypeVar("Result")


class Recorder:
    """Calls functions by what ``dr.freeze`` has recorded of them, if it has: that spares the tenths
    of a second in which Dr.Jit traces a kernel only to find that it has been compiled before.

    ``about`` are the objects that such functions read on the host, such as the scene: a recording
    holds what was found there as constants, and is never used for others. Nothing is recorded if
    that isn't ``possible``.
    """

    def __init__(self, *about: object, possible: bool = True):
        self.about = about
        self._frozen: dict[Hashable, Callable] = {}
        self._possible = possible
        self._impossible: set[Hashable] = set()

    def is_about(self, *objects: object) -> bool:
        """Is it for these very objects?"""
        return all(ours is theirs for ours, theirs in zip(self.about, objects, strict=True))

    def __call__(self, key: Hashable, function: Callable[..., Result], *inputs: object) -> Result:
        """``function(*inputs)``.

        All Dr.Jit arrays that the function reads have to be among the inputs or in them: in lists,
        dataclasses and objects of Mitsuba's. It's recorded anew if anything else in them differs,
        or ``key``, which stands for what they don't show.
        """
        if not self._possible or key in self._impossible or counting():
            return function(*inputs)
        try:
            return self._frozen_of(key)(function, *inputs)
        except RuntimeError as error:
            cause = _first_cause(error)
            if was_interrupted() or not isinstance(cause, RuntimeError):
                raise cause from None
        # It reads an array that isn't among the inputs, or that a plugin doesn't show.
        mi.Log(mi.LogLevel.Debug, f"can't be recorded, and takes longer: {cause}")
        self._impossible.add(key)
        return function(*inputs)

    def _frozen_of(self, key: Hashable) -> Callable:
        """Dr.Jit turns numbers that differ from call to call into data: for each key by itself."""
        if key not in self._frozen:
            self._frozen = dict([*self._frozen.items()][1 - MOST_KEYS :])
            self._frozen[key] = dr.freeze(_call, limit=MOST_RECORDINGS, warn_after=1 << 30)
        return self._frozen[key]

    @property
    def n_recordings(self) -> int:
        """How often something has been recorded."""
        return sum(frozen.n_recordings for frozen in self._frozen.values())


def _call(function, *inputs):
    return function(*inputs)


def _first_cause(error: BaseException) -> BaseException:
    """Dr.Jit makes ``RuntimeError`` of whatever is raised while it records."""
    while error.__cause__ or error.__context__:
        error = error.__cause__ or error.__context__
    return error
