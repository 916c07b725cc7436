"""Patches that light falls on too unevenly for one irradiance to stand for all of it."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from .direct_light import SAMPLES, DirectLight
from .patches import Patches, drop

#: Slices of a patch along each axis that are compared.
SLICES = 4
#: A patch is uneven if a slice of it gets this many times less or more direct light than all of it,
#: beyond doubt: by this many standard errors, where this many samples should have found light.
CONTRAST, SIGNIFICANCE, MIN_LIT = 2.0, 4.0, 6.0


def drop_uneven(
    light: DirectLight, patches: Patches, patch_of_point: np.ndarray
) -> tuple[Patches, np.ndarray]:
    """Drop patches across sharp edges of light: paths that come there are traced on instead.

    Such patches would leak: light on one side of a door frame into the dark room on the other.
    Returns the remaining patches and the patch of every surface point [N], -1 where it has none.
    """
    if len(light) == 0:
        return patches, patch_of_point
    dropped = np.zeros(patches.count, dtype=bool)
    dropped[light.members.patches[uneven(light.irradiance, light.position).numpy()]] = True
    return drop(patches, patch_of_point, dropped)


def uneven(irradiance: mi.Float, position: mi.Point3f) -> mi.Bool:
    """Which of K patches are uneven, by ``SAMPLES`` samples [K * SAMPLES] of each."""
    # About the mean: squares of large numbers that differ little would lose all digits.
    n = mi.Float(SAMPLES)
    mean = dr.block_sum(irradiance, SAMPLES) / n
    centred = irradiance - dr.repeat(mean, SAMPLES)
    error = dr.sqrt(dr.block_sum(dr.square(centred), SAMPLES) / (n * (n - 1)))
    lit = dr.block_sum(dr.select(irradiance > 0, mi.Float(1), 0), SAMPLES) / n
    dr.eval(mean, centred, error, lit)
    found = dr.zeros(mi.Bool, dr.width(mean))
    for x in position:
        low = dr.block_reduce(dr.ReduceOp.Min, x, SAMPLES)
        high = dr.block_reduce(dr.ReduceOp.Max, x, SAMPLES)
        found |= _slices_differ(x, centred, low, high, mean, error, lit)
        dr.eval(found)
    return found


@dr.syntax
def _slices_differ(x, centred, low, high, mean, error, lit):
    """Is a slice along an axis, on which samples lie at ``x``, lit otherwise than its patch?"""
    n = [mi.Float(0) for _ in range(SLICES)]
    total = [mi.Float(0) for _ in range(SLICES)]
    square = [mi.Float(0) for _ in range(SLICES)]
    scale = SLICES / dr.maximum(high - low, dr.smallest(mi.Float))
    first = dr.arange(mi.UInt32, dr.width(mean)) * SAMPLES
    i = mi.UInt32(0)
    while dr.hint(i < SAMPLES, exclude=[x, centred], label="Compare slices"):
        difference = dr.gather(mi.Float, centred, first + i)
        slice_ = mi.UInt32((dr.gather(mi.Float, x, first + i) - low) * scale)
        slice_ = dr.minimum(slice_, SLICES - 1)
        for k in range(SLICES):
            inside = slice_ == k
            n[k] += dr.select(inside, 1, 0)
            total[k] += dr.select(inside, difference, 0)
            square[k] += dr.select(inside, dr.square(difference), 0)
        i += 1

    differs = mi.Bool(False)
    for k in range(SLICES):
        n_k = dr.maximum(n[k], 1)
        part = mean + total[k] / n_k
        variance = dr.maximum(square[k] - dr.square(total[k]) / n_k, 0) / dr.maximum(n_k - 1, 1)
        doubt = SIGNIFICANCE * dr.sqrt(variance / n_k + dr.square(error))
        contrast = (part > CONTRAST * mean) | (mean > CONTRAST * part)
        certain = (dr.abs(part - mean) > doubt) & (n[k] * lit >= MIN_LIT)
        differs |= contrast & certain
    return differs
