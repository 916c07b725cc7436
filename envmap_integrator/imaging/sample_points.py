"""The integrators' own sample points: stratified in each pixel, coherent across pixels.

What the cache and the maps leave of light transport has few dimensions, so points that are well
spread in each pair of dimensions pay. They are those of a (0,2)-sequence (Sobol' 1967), another one
for each pair of dimensions: shuffled and scrambled by Owen's method with hashes (Laine and Karras
2011; Burley 2020), for any number of samples. Neighbouring pixels, which share SIMD registers, take
the same strata in the same order, so that their rays go about the same way, hit the same surfaces
and end together; within the strata, each pixel has its own points. There are as many strata as the
largest power of two that divides the number of samples: each pixel has equally many samples in each
of them, so that the errors of neighbours have nothing in common.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from ..system.jit import LANES_ALIKE, mix, unit

#: Odd constants that tell the hashes of different things apart (golden ratio; plastic number).
_BY_DIMENSION, _BY_LANE, _SECOND = 0x9E3779B1, 0xC13FA9A9, 0x91E10DA5


def shared_strata(count: int) -> int:
    """Base-2 logarithm of the number of strata that a group of lanes shares, of ``count`` samples
    for each lane.
    """
    return (count & -count).bit_length() - 1


@dataclass
class SamplePoints:
    """Points in the unit interval and square for every sample of a pixel, as Mitsuba's samplers
    give them.

    pattern    [N]  hash of the seed and the group of lanes
    own        [N]  hash of the seed and the lane
    strata     []   ``shared_strata``
    index      [N]  of the sample
    dimension  [N]  how many numbers and pairs of numbers of the sample have been drawn
    """

    pattern: mi.UInt32
    own: mi.UInt32
    strata: mi.UInt32
    index: mi.UInt32
    dimension: mi.UInt32

    @classmethod
    def of(
        cls, seed: mi.UInt32, lane: mi.UInt32, strata: mi.UInt32, first: mi.UInt32
    ) -> SamplePoints:
        """Points for each lane, from the sample ``first`` on; see ``shared_strata``."""
        seed = mix(seed + _SECOND)
        return cls(
            pattern=mix(seed ^ (lane // LANES_ALIKE) * _BY_LANE),
            own=mix(~seed ^ lane * _BY_LANE),
            strata=strata,
            index=mi.UInt32(first),
            dimension=mi.UInt32(0),
        )

    def of_sample(self, index: mi.UInt32) -> SamplePoints:
        """Those of another sample, from its first dimension on."""
        return replace(self, index=mi.UInt32(index), dimension=mi.UInt32(0))

    def next_1d(self, active: mi.Bool | bool = True) -> mi.Float:
        """A number in [0, 1)."""
        shuffled, scramble, own = self._next()
        bits = dr.brev(_scrambled(shuffled, mix(scramble + _SECOND)))
        return unit(bits ^ (own >> self.strata))

    def next_2d(self, active: mi.Bool | bool = True) -> mi.Point2f:
        """A point in the unit square."""
        shuffled, scramble, own = self._next()
        scramble = mix(scramble + _SECOND)
        x = dr.brev(_scrambled(shuffled, scramble))
        y = dr.brev(_scrambled(_pascal(shuffled), mix(scramble + _SECOND)))
        strata = self.strata >> 1
        return mi.Point2f(unit(x ^ (own >> strata)), unit(y ^ (mix(own + _SECOND) >> strata)))

    def _next(self) -> tuple[mi.UInt32, mi.UInt32, mi.UInt32]:
        """Index in the sequence of a new dimension, its hash for a group of lanes and for one."""
        step = self.dimension * _BY_DIMENSION
        # The first is the place in the pixel, and all that follows depends on what is seen there:
        # did the strata of both meet alike in all lanes, these would share part of their errors.
        pattern = dr.select(self.dimension == 0, self.own ^ _SECOND, self.pattern)
        scramble = mix(pattern + step)
        self.dimension = self.dimension + 1
        return dr.brev(_scrambled(dr.brev(self.index), scramble)), scramble, mix(self.own + step)


def _scrambled(x: mi.UInt32, seed: mi.UInt32) -> mi.UInt32:
    """Owen's scrambling of numbers whose bits stand in reversed order.

    The hash of Laine and Karras with the constants that N. Vegdahl has searched for: a bit is
    changed by the lower ones alone.
    """
    x = x ^ x * 0x3D20ADEA
    x = x + seed
    x = x * ((seed >> 16) | 1)
    x = x ^ x * 0x05526C56
    x = x ^ x * 0x53A22864
    return x


def _pascal(x: mi.UInt32) -> mi.UInt32:
    """Second dimension of the sequence, bits reversed: by Pascal's triangle modulo 2."""
    x = x ^ x >> 16
    x = x ^ (x & 0xFF00FF00) >> 8
    x = x ^ (x & 0xF0F0F0F0) >> 4
    x = x ^ (x & 0xCCCCCCCC) >> 2
    x = x ^ (x & 0xAAAAAAAA) >> 1
    return x
