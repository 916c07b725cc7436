"""Random numbers of the pre-passes."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from .jit import unit

#: Step of the counter, and factors of the mixer (SplitMix64; Steele, Lea and Flood 2014).
_STEP, _MIX = 0x9E3779B97F4A7C15, (0xBF58476D1CE4E5B9, 0x94D049BB133111EB)


@dataclass
class RandomNumbers:
    """Independent uniform numbers for each lane, in place of a sampler.

    Those of Mitsuba come from two words a lane, which a kernel of its own has to write; a loop is
    traced twice with them, as one of the words stays the same.

    state   what the next number is made of
    """

    state: mi.UInt64

    @staticmethod
    def of_lanes(seed: int, count: int) -> RandomNumbers:
        """Numbers for so many lanes; other seeds, as data, give others."""
        lane = mi.UInt64(dr.arange(mi.UInt32, count))
        return RandomNumbers(_mixed(lane | mi.UInt64(dr.opaque(mi.UInt32, seed)) << 32))

    @staticmethod
    def of_keys(seed: int, key: mi.UInt32, number: mi.UInt32) -> RandomNumbers:
        """Numbers for each key and number, in whatever lane they are."""
        both = mi.UInt64(key) << 32 | mi.UInt64(number)
        return RandomNumbers(_mixed(_mixed(both) ^ mi.UInt64(dr.opaque(mi.UInt32, seed))))

    def next_1d(self) -> mi.Float:
        """A number in [0, 1)."""
        return unit(mi.UInt32(self._next() >> 32))

    def next_2d(self) -> mi.Point2f:
        """A point in the unit square."""
        bits = self._next()
        return mi.Point2f(unit(mi.UInt32(bits >> 32)), unit(mi.UInt32(bits)))

    def _next(self) -> mi.UInt64:
        self.state += _STEP
        return _mixed(self.state)


def _mixed(h: mi.UInt64) -> mi.UInt64:
    """Every input bit affects every output bit."""
    h = (h ^ (h >> 30)) * _MIX[0]
    h = (h ^ (h >> 27)) * _MIX[1]
    return h ^ (h >> 31)
