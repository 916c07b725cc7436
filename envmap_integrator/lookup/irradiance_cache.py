"""The irradiance cache, as kernels read it."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from .patches import Patches


@dataclass(frozen=True)
class IrradianceCache:
    """Irradiance on the patches; each side of a surface has patches of its own.

    patches   the coarse mesh
    table     [2 * P * C]  W/m²: row 2p total, row 2p + 1 indirect irradiance of patch p, by C
                           colour channels
    error     [P]          W/m²: standard error of total irradiance, mean of the colour channels;
                           None while the cache is being made
    """

    patches: Patches
    table: mi.Float
    error: mi.Float | None = None

    def irradiance(self, row: mi.UInt32, active: mi.Bool | bool = True) -> mi.Spectrum:
        """Irradiance [W/m²] in a row of the table."""
        return dr.gather(mi.Spectrum, self.table, row, active)

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
