"""Small helpers around Dr.Jit."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np


def upload(dtype: type, values: np.ndarray) -> mi.Float | mi.UInt32:
    """A one-dimensional Dr.Jit array of NumPy values, in memory of Dr.Jit's own.

    A plain conversion would map NumPy's memory. Where that isn't aligned, packed gathers fall
    apart into scalar ones, and kernels differ from run to run.
    """
    values = np.ascontiguousarray(values).ravel()
    result = dr.empty(dtype, len(values))
    if len(values):
        dr.scatter(result, dtype(values), dr.arange(mi.UInt32, len(values)))
        dr.eval(result)
    return result


def opaque_point(values) -> mi.Point3f:
    """A point that kernels read as data: changing it compiles nothing."""
    point = mi.Point3f(*(float(value) for value in values))
    dr.make_opaque(point)
    return point


def mix(h: mi.UInt32) -> mi.UInt32:
    """Finaliser of MurmurHash3: every input bit affects every output bit."""
    h = (h ^ (h >> 16)) * 0x85EBCA6B
    h = (h ^ (h >> 13)) * 0xC2B2AE35
    return h ^ (h >> 16)


class SpareNumbers:
    """Uniform random numbers where quality hardly matters, many from one sample of the sampler.

    A 32 bit hash costs a fraction of a step of the samplers' 64 bit generators.
    """

    def __init__(self, sample: mi.Float):
        self._bits = mi.UInt32(sample * 16777216.0)
        self._count = 0

    def next_1d(self) -> mi.Float:
        self._count += 1
        return mi.Float(mix(self._bits + self._count * 0x9E3779B1 % 2**32) >> 8) / 16777216.0

    def next_2d(self) -> mi.Point2f:
        return mi.Point2f(self.next_1d(), self.next_1d())
