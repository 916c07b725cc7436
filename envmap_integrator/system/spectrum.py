"""What a variant's spectra are, and how those that are stored hold them.

In spectral variants a ray carries four wavelengths, and ``mi.Spectrum`` is what there is at these.
What is stored, the cache and the maps, holds means over bins of wavelengths instead, and is read in
the bin of each wavelength. Materials and emitters are asked at the wavelengths themselves, so only
what arrives at a surface is binned, neither what it reflects nor what emitters emit.

The bins are equally likely among the wavelengths that cameras sample, so they are narrow where the
eye is sensitive: 4 nm to 7 nm wide from 430 nm to 645 nm, as tables of colour science have them,
and less than 15 nm from 370 nm to 735 nm. They make packets of as many bins as a ray has
wavelengths, spread as these are: stored values are found packet by packet, by rays of its own. In
other variants a stored value is an ``mi.Spectrum``, there is one packet, and no wavelengths.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import drjit as dr
import mitsuba as mi
import numpy as np

from .jit import upload

#: Bins of wavelengths of a stored value in spectral variants.
BINS = 64
#: Where the distribution of sampled wavelengths is cut off and how wide it is, as
#: ``mi.sample_rgb_spectrum`` has them [1, 1, nm, nm].
_OFFSET, _SCALE, _MIDDLE, _WIDTH = 0.8569106254698279, 1.8275019724092267, 538.0, 1 / 0.0072
#: Wavelengths of a ray, and the bins of a stored value in its order: packet by packet.
_PER_RAY = 4
_ORDER = np.arange(BINS).reshape(_PER_RAY, -1).T.ravel()


def n_stored() -> int:
    """How many numbers a stored value has."""
    return BINS if mi.is_spectral else len(mi.Spectrum())


def n_packets() -> int:
    """How many spectra make a stored value."""
    return n_stored() // len(mi.Spectrum())


def bin_names() -> tuple[str, ...]:
    """Names of the bins by their middles, in the order of a stored value."""
    u = (np.arange(BINS) + 0.5) / BINS
    middles = _MIDDLE - _WIDTH * np.arctanh(_OFFSET - _SCALE * u)
    return tuple(f"{middles[i]:.0f}nm" for i in _ORDER)


# ---------------------- Wavelengths ----------------------


def wavelengths_at(u: mi.Float) -> mi.Color0f | mi.Spectrum:
    """Wavelengths [nm] of a ray, a quarter of their distribution apart, from a number in [0, 1)."""
    if not mi.is_spectral:
        return mi.Color0f()
    n = len(mi.Spectrum())
    shifted = (u + i / n for i in range(n))
    return mi.sample_rgb_spectrum(mi.Spectrum(*(x - dr.floor(x) for x in shifted)))[0]


def wavelength_sample(sampler: mi.Sampler) -> mi.Float | int:
    """A number in [0, 1) by which sensors sample wavelengths; where there are none, it's 0."""
    return sampler.next_1d() if mi.is_spectral else 0


def random_wavelengths(sampler: mi.Sampler) -> mi.Color0f | mi.Spectrum:
    """Wavelengths [nm] of rays that come from no sensor, as cameras sample them."""
    return wavelengths_at(wavelength_sample(sampler))


def packet_wavelengths(packet: mi.UInt32, u: mi.Float) -> mi.Color0f | mi.Spectrum:
    """Wavelengths [nm], one in each bin of a packet; ``u`` in [0, 1) says where in them."""
    return wavelengths_at((mi.Float(packet) + u) / BINS)


def _place(wavelength: mi.Float) -> tuple[mi.UInt32, mi.UInt32]:
    """Packet and place in it of the bin that a wavelength [nm] lies in."""
    u = (_OFFSET - dr.tanh((_MIDDLE - wavelength) / _WIDTH)) / _SCALE
    bin_ = mi.UInt32(dr.clip(u * BINS, 0, BINS - 1))
    return bin_ % n_packets(), bin_ // n_packets()


# ---------------------- Stored values ----------------------


def read_at(
    table: mi.Float,
    row_of_packet: Callable[[mi.UInt32 | int], mi.UInt32],
    wavelengths: mi.Color0f | mi.Spectrum,
    active: mi.Bool | bool = True,
) -> mi.Spectrum:
    """What a table of packets holds at wavelengths [nm].

    ``row_of_packet`` gives the row for a packet.
    """
    if not mi.is_spectral:
        return dr.gather(mi.Spectrum, table, row_of_packet(0), active)
    places = map(_place, wavelengths)
    size = len(mi.Spectrum())
    rows = (size * row_of_packet(packet) + place for packet, place in places)
    return mi.Spectrum(*(dr.gather(mi.Float, table, row, active) for row in rows))


def read_rgb(
    table: mi.Float,
    row_of_packet: Callable[[mi.UInt32 | int], mi.UInt32],
    active: mi.Bool | bool = True,
) -> tuple[mi.Float, mi.Float, mi.Float]:
    """The colour, as films have it, of what a table of packets holds."""
    colours = [
        seen(
            dr.gather(mi.Spectrum, table, row_of_packet(packet), active),
            packet_wavelengths(packet, 0.5),
        )
        for packet in range(n_packets())
    ]
    return rgb(sum(colours[1:], colours[0]) / len(colours))


def row_of(index: mi.UInt32, packet: mi.UInt32 | int) -> mi.UInt32:
    """Row for a packet in a table that has all packets of each stored value one after the other."""
    n = n_packets()
    return index if n == 1 else n * index + packet


def padded(texels: np.ndarray) -> np.ndarray:
    """Texels [T, C + 1], a stored value and one more number, as ``read_texel`` finds them."""
    size = texels.shape[1]
    return np.pad(texels, ((0, 0), (0, -size % len(mi.Spectrum())))) if mi.is_spectral else texels


def read_texel(
    table: mi.Float,
    index: mi.UInt32,
    wavelengths: mi.Color0f | mi.Spectrum,
    active: mi.Bool | bool = True,
) -> mi.Spectrum:
    """The stored value of a texel at wavelengths [nm]."""
    if not mi.is_spectral:
        texel = dr.gather(_texel_type(), table, index, active)
        return mi.Spectrum(*(texel[i] for i in range(n_stored())))
    rows = n_packets() + 1
    return read_at(table, lambda packet: rows * index + packet, wavelengths, active)


def read_last(table: mi.Float, index: mi.UInt32, active: mi.Bool | bool = True) -> mi.Float:
    """What a texel holds besides."""
    if not mi.is_spectral:
        return dr.gather(_texel_type(), table, index, active)[n_stored()]
    size = len(mi.Spectrum()) * (n_packets() + 1)
    return dr.gather(mi.Float, table, size * index + n_stored(), active)


def _texel_type() -> type:
    """Type of a texel that is read at once."""
    return {1: mi.Vector2f, 3: mi.Vector4f}[len(mi.Spectrum())]


def as_rgb(values: np.ndarray) -> np.ndarray:
    """Colours [..., 3] of stored values [..., BINS]; values of other variants as they are."""
    if values.shape[-1] != BINS:
        return values
    index = dr.arange(mi.UInt32, values.size // BINS)
    colours = read_rgb(upload(mi.Float, values), partial(row_of, index))
    return np.stack([c.numpy() for c in colours], axis=-1).reshape(*values.shape[:-1], 3)


# ---------------------- Colours ----------------------


def colour_type() -> type:
    """Type of colours that are never negative and add up over samples of any wavelengths."""
    return mi.Color3f if mi.is_spectral else mi.Spectrum


def colour(value: mi.Spectrum, wavelengths: mi.Color0f | mi.Spectrum) -> mi.Spectrum | mi.Color3f:
    """Such a colour of a spectrum over the density of its wavelengths: XYZ, or the spectrum."""
    return mi.spectrum_to_xyz(value, wavelengths) if mi.is_spectral else value


def seen(value: mi.Spectrum, wavelengths: mi.Color0f | mi.Spectrum) -> mi.Spectrum | mi.Color3f:
    """The ``colour`` of a spectrum at wavelengths that cameras have sampled."""
    if not mi.is_spectral:
        return value
    return colour(value / mi.pdf_rgb_spectrum(wavelengths), wavelengths)


def rgb(value: mi.Spectrum | mi.Color3f) -> tuple[mi.Float, mi.Float, mi.Float]:
    """What films hold of a ``colour``."""
    if mi.is_spectral:
        return tuple(mi.xyz_to_srgb(value))
    return tuple(value) if len(value) == 3 else (value[0],) * 3
