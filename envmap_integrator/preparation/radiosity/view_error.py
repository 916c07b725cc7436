"""How uncertain the irradiance cache leaves the picture of a view that it wasn't made for.

Walks from the sensor meet patches as often as its picture hangs on them; the errors of these, which
are independent, add up to that of the picture. (``noise`` knows more about the views that the cache
is made for, from the gather rays, which aren't kept.)
"""

from __future__ import annotations

import numpy as np

from ...lookup.irradiance_cache import IrradianceCache
from ...lookup.patches import Cell
from ...system.spectrum import n_packets
from ..coarse_mesh.surface_points import SurfacePoints


def view_error(
    points: SurfacePoints, cell: Cell, patch: np.ndarray, even: np.ndarray, cache: IrradianceCache
) -> float:
    """Standard error of the brightness of a view's picture, over that brightness [1].

    ``points`` are those of ``walk_from`` the sensor, ``cell`` and ``patch`` [N] what is found there
    in the coarse mesh of the ``cache``, -1 where nothing is, and ``even`` [N] whether light is even
    there. Infinite for a view of patches that are all dark.
    """
    # ---- Points sorted by walk, and by bounce; the first ones gather by rays of their own ----
    order = np.argsort(points.start, kind="stable")
    walk, position, reflects, diffuse = (
        x[order] for x in (points.start, points.position, points.reflects, points.diffuse)
    )
    index, even, size = (x[order] for x in (patch, even, cell.patch_size.numpy()))
    found = index >= 0
    first = np.append(True, walk[1:] != walk[:-1])
    seen = found & first
    total = cache.mean_channel().reshape(-1, n_packets(), 2).mean(axis=1)[:, 0]
    brightness = reflects[seen] @ total[index[seen]]
    if brightness == 0:
        return np.inf if seen.any() else 0.0

    # ---- Others are read in their diffuse lobes, unless they are near (``transport.ending``); what
    # light has passed before it's read has been gathered, from near and far ----
    reads = found & diffuse & ~first
    distance = np.append(np.inf, np.linalg.norm(np.diff(position, axis=0), axis=1))
    near = np.where(reads, np.clip(1.5 - distance / size, 0, 1), 1)
    gathered = 1 - _product_along(near, np.cumsum(first) - 1)
    error = cache.error.numpy()[2 * index + np.where(even, 0, 1)] * gathered * reflects

    # ---- A patch counts by the square of its weight in the picture, as pairs of walks tell ----
    n_patches = cache.patches.count
    by_walk, place = np.unique(n_patches * walk[reads] + index[reads], return_inverse=True)
    own = np.bincount(place, error[reads])
    by_patch = np.bincount(by_walk % n_patches, own)
    variance = np.square(by_patch).sum() - np.square(own).sum()
    return float(np.sqrt(max(variance, 0.0)) / brightness)


def _product_along(values: np.ndarray, walk: np.ndarray) -> np.ndarray:
    """Products of the values [N] up to each in its walk; these come one after the other, from 0."""
    step = np.arange(len(walk)) - np.searchsorted(walk, walk)
    table = np.ones((walk[-1] + 1, step.max() + 1))
    table[walk, step] = values
    return np.cumprod(table, axis=1)[walk, step]
