"""The irradiance cache, as kernels read it."""

from __future__ import annotations

from dataclasses import dataclass

import mitsuba as mi
import numpy as np

from ..system.jit import upload
from ..system.spectrum import n_packets, read_at, read_rgb
from .patches import Patches


@dataclass(frozen=True)
class IrradianceCache:
    """Irradiance on the patches; each side of a surface has patches of its own.

    patches   the coarse mesh
    table     [2 * P * C]  W/m²: row 2p total, row 2p + 1 indirect irradiance of patch p, by C
                           colour channels. Of n packets of wavelengths, row 2 (n p + packet) and
                           the next
    error     [2 * P]      W/m²: standard error of the irradiance in rows 2p and 2p + 1, mean of the
                           colour channels; None while the cache is being made
    hue       [C]          typical spectrum of the patches' indirect irradiance, with a mean of 1;
                           None without wavelengths, and while the cache is being made
    """

    patches: Patches
    table: mi.Float
    error: mi.Float | None = None
    hue: mi.Float | None = None

    @classmethod
    def of(cls, patches: Patches, table: mi.Float, error: mi.Float) -> IrradianceCache:
        """A cache that has been made."""
        return cls(patches, table, error, _hue(table) if mi.is_spectral else None)

    def irradiance(
        self,
        row: mi.UInt32,
        wavelengths: mi.Color0f | mi.Spectrum,
        active: mi.Bool | bool = True,
    ) -> mi.Spectrum:
        """Irradiance [W/m²] at wavelengths [nm]: 2p total, 2p + 1 indirect."""
        return read_at(self.table, lambda packet: packet_row(row, packet), wavelengths, active)

    def hue_at(self, wavelengths: mi.Spectrum) -> mi.Spectrum:
        """``hue`` at wavelengths [nm]."""
        return read_at(self.hue, mi.UInt32, wavelengths)

    def rgb(
        self, row: mi.UInt32, active: mi.Bool | bool = True
    ) -> tuple[mi.Float, mi.Float, mi.Float]:
        """The same as the colour [W/m²] that films would hold of it."""
        return read_rgb(self.table, lambda packet: packet_row(row, packet), active)

    def same_as(self, other: IrradianceCache) -> bool:
        """Does it hold the same to the bit?"""
        ours, theirs = (
            (cache.patches.cells, cache.patches.levels, cache.table, cache.error)
            for cache in (self, other)
        )
        pairs = zip(ours, theirs, strict=True)
        return all(np.array_equal(a.numpy(), b.numpy()) for a, b in pairs)

    def mean_channel(self) -> np.ndarray:
        """The table's rows [2 * P] in W/m², mean of the colour channels."""
        n_channels = len(mi.Spectrum())
        return self.table.numpy().reshape(-1, n_channels) @ np.full(n_channels, 1 / n_channels)


def packet_row(row: mi.UInt32, packet: mi.UInt32 | int) -> mi.UInt32:
    """Row of the table for a packet, of the row 2p or 2p + 1 that stands for a patch."""
    n = n_packets()
    return row if n == 1 else 2 * (n * (row >> 1) + packet) + (row & 1)


def _hue(table: mi.Float) -> mi.Float:
    """Mean over the spectra of the patches, each with a mean of 1, however bright it is."""
    indirect = table.numpy().reshape(-1, n_packets(), 2, len(mi.Spectrum()))[:, :, 1]
    indirect = indirect.reshape(len(indirect), -1).astype(np.float64)
    mean = indirect.mean(axis=1, keepdims=True)
    hue = (indirect / np.where(mean > 0, mean, 1)).sum(axis=0)
    return upload(mi.Float, hue / hue.mean() if hue.any() else np.ones_like(hue))
