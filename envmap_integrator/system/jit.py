"""Small helpers around Dr.Jit."""

from __future__ import annotations

from collections.abc import Iterable

import drjit as dr
import mitsuba as mi
import numpy as np

#: Neighbouring lanes that take the same strata: they share SIMD registers.
LANES_ALIKE = 16


#: Alignment [bytes] of Dr.Jit's own memory.
_ALIGNMENT = 64
#: Floats from which on freed memory is handed back.
_LARGE = 1 << 24


def upload(dtype: type, values: np.ndarray) -> mi.Float | mi.UInt32:
    """A one-dimensional Dr.Jit array of NumPy values.

    Dr.Jit maps NumPy's memory as it is. Where that isn't aligned, which is a matter of chance,
    packed gathers fall apart into scalar ones and every kernel is compiled again.
    """
    values = np.asarray(values)
    own = np.dtype(np.float32 if dr.is_float_v(dtype) else np.uint32)
    n_bytes = own.itemsize * values.size
    memory = np.empty(n_bytes + _ALIGNMENT, dtype=np.uint8)
    begin = -memory.ctypes.data % _ALIGNMENT
    aligned = memory[begin : begin + n_bytes].view(own)
    np.copyto(aligned.reshape(values.shape), values, casting="unsafe")
    return dtype(aligned)


def upload_vectors(dtype: type, values: np.ndarray) -> mi.Vector3f:
    """A Dr.Jit array of vectors of the rows of NumPy values [N, 3]."""
    return dtype(*(upload(mi.Float, component) for component in values.T))


def opaque_point(values: Iterable[float]) -> mi.Point3f:
    """A point that kernels read as data: changing it compiles nothing."""
    point = mi.Point3f(*(float(value) for value in values))
    dr.make_opaque(point)
    return point


def mean_channel(colour: mi.Spectrum) -> mi.Float:
    """Mean of the channels of colours; ``dr.mean`` puts the number of lanes into the kernel."""
    return dr.sum(colour) / len(colour)


#: Steps of the R1 and the R2 sequence (Roberts 2018).
R1 = 0.6180339887498949
R2 = (0.7548776662466927, 0.5698402909980532)


def mix(h: mi.UInt32) -> mi.UInt32:
    """Finaliser of MurmurHash3: every input bit affects every output bit."""
    h = (h ^ (h >> 16)) * 0x85EBCA6B
    h = (h ^ (h >> 13)) * 0xC2B2AE35
    return h ^ (h >> 16)


def unit(bits: mi.UInt32) -> mi.Float:
    """A number in [0, 1) from the upper bits of a random integer."""
    return mi.Float(bits >> 8) / 16777216.0


class SpareNumbers:
    """Uniform random numbers where quality hardly matters, many from one sample of the sampler.

    A 32 bit hash costs a fraction of a step of the samplers' 64 bit generators.
    """

    def __init__(self, sample: mi.Float):
        self._bits = mi.UInt32(sample * 16777216.0)
        self._count = 0

    def next_1d(self) -> mi.Float:
        """A number in [0, 1)."""
        self._count += 1
        return unit(mix(self._bits + self._count * 0x9E3779B1 % 2**32))

    def next_2d(self) -> mi.Point2f:
        """A point in the unit square."""
        return mi.Point2f(self.next_1d(), self.next_1d())


def give_back(n_floats: int) -> None:
    """Hand freed memory back to the system if it was about so large: that takes a while."""
    if n_floats >= _LARGE:
        dr.flush_malloc_cache()
