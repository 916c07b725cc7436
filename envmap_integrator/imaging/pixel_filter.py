"""Camera samples spread as the film's reconstruction filter weights them (Ernst et al. 2006).

A sample then counts for one pixel only, and the pixels' errors are independent.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..system.jit import upload

#: Cells of the tabulated inverse of the filter's distribution, and steps of its integration.
CELLS, STEPS = 8192, 1 << 14


@dataclass(frozen=True)
class PixelFilter:
    """Offsets from a pixel's centre, in proportion to the size of a separable filter.

    inverse   [CELLS + 1]  inverse of the filter's distribution, pixels
    weight    [1]          of a sample, in size, for each direction
    rfilter                the filter, if it has negative lobes
    """

    inverse: mi.Float
    weight: float
    rfilter: mi.ReconstructionFilter | None

    @classmethod
    def of(cls, rfilter: mi.ReconstructionFilter) -> PixelFilter:
        """That of a film."""
        radius = rfilter.radius()
        edges = np.linspace(-radius, radius, STEPS + 1)
        middles = (edges[1:] + edges[:-1]) / 2
        value = rfilter.eval(upload(mi.Float, middles)).numpy().astype(np.float64)
        size = np.abs(value)
        # Negative lobes count negatively; the sum of weights stays that of a plain mean.
        weight = float(size.sum() / value.sum())
        share = np.concatenate([[0], np.cumsum(size)]) / size.sum()
        inverse = upload(mi.Float, np.interp(np.linspace(0, 1, CELLS + 1), share, edges))
        return cls(inverse, weight, rfilter if (value < 0).any() else None)

    def sample(self, u: mi.Point2f) -> tuple[mi.Vector2f, mi.Float]:
        """An offset [pixels] and its weight [1], whose mean is one."""
        x, weight_x = self._sample(u.x)
        y, weight_y = self._sample(u.y)
        return mi.Vector2f(x, y), weight_x * weight_y

    def _sample(self, u):
        cell = u * CELLS
        index = mi.UInt32(cell)
        below = dr.gather(mi.Float, self.inverse, index)
        above = dr.gather(mi.Float, self.inverse, index + 1)
        x = dr.lerp(below, above, cell - mi.Float(index))
        if self.rfilter is None:
            return x, mi.Float(1)
        return x, self.weight * dr.sign(self.rfilter.eval(x))
