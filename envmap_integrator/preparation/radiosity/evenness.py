"""Patches that light falls on too unevenly for one irradiance to stand for all of it."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..coarse_mesh.mesh import CoarseMesh
from .direct_light import SAMPLES, DirectLight

#: Slices of a patch along each axis that are compared.
SLICES = 4
#: A patch has an edge of light if a slice of it gets this many times less or more direct light than
#: all of it, and direct light falls on it unevenly if a slice gets so many times less or more.
EDGE, UNEVEN = 2.0, 1.25
#: Both beyond doubt: by this many standard errors, where this many samples should have found light.
SIGNIFICANCE, MIN_LIT = 4.0, 6.0


def sort_out_uneven(light: DirectLight, mesh: CoarseMesh) -> CoarseMesh:
    """Drop patches across sharp edges of light, and mark those across soft ones.

    The first would leak: light on one side of a door frame into the dark room on the other. Paths
    that come there are traced on instead. Of the others, shadow rays bring the direct light, as
    their mean misplaces it: light may leave a room through a slit that shows a part of them.
    Patches are marked too where bumps turn the normals, which is unevenness at a finer scale.
    """
    if len(light) == 0:
        return mesh
    patch_of_point = mesh.patch_of_point
    marked, dropped = (np.zeros(mesh.patches.count, dtype=bool) for _ in range(2))
    edge, uneven = contrasts(light.irradiance, light.position)
    dropped[light.members.patches[edge.numpy()]] = True
    marked[light.members.patches[uneven.numpy()]] = True
    marked[patch_of_point[light.members.points.turned & (patch_of_point >= 0)]] = True
    return mesh.with_uneven(marked).without(dropped)


def contrasts(irradiance: mi.Float, position: mi.Point3f) -> tuple[mi.Bool, mi.Bool]:
    """Which of K patches have an edge of light, and on which it falls unevenly.

    Told by ``SAMPLES`` samples [K * SAMPLES] of each.
    """
    # About the mean: squares of large numbers that differ little would lose all digits.
    n = mi.Float(SAMPLES)
    mean = dr.block_sum(irradiance, SAMPLES) / n
    centred = irradiance - dr.repeat(mean, SAMPLES)
    error = dr.sqrt(dr.block_sum(dr.square(centred), SAMPLES) / (n * (n - 1)))
    lit = dr.block_sum(dr.select(irradiance > 0, mi.Float(1), 0), SAMPLES) / n
    dr.eval(mean, centred, error, lit)
    edge, uneven = (dr.zeros(mi.Bool, dr.width(mean)) for _ in range(2))
    for x in position:
        low = dr.block_reduce(dr.ReduceOp.Min, x, SAMPLES)
        high = dr.block_reduce(dr.ReduceOp.Max, x, SAMPLES)
        along_x = _slices_differ(x, centred, low, high, mean, error, lit)
        edge |= along_x[0]
        uneven |= along_x[1]
        dr.eval(edge, uneven)
    return edge, uneven


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

    edge, uneven = mi.Bool(False), mi.Bool(False)
    for k in range(SLICES):
        n_k = dr.maximum(n[k], 1)
        part = mean + total[k] / n_k
        variance = dr.maximum(square[k] - dr.square(total[k]) / n_k, 0) / dr.maximum(n_k - 1, 1)
        doubt = SIGNIFICANCE * dr.sqrt(variance / n_k + dr.square(error))
        certain = (dr.abs(part - mean) > doubt) & (n[k] * lit >= MIN_LIT)
        edge |= certain & _contrast(part, mean, EDGE)
        uneven |= certain & _contrast(part, mean, UNEVEN)
    return edge, uneven


def _contrast(a, b, least):
    return (a > least * b) | (b > least * a)
