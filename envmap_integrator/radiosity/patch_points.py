"""The surface points that stand for each patch."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.sparse import coo_matrix

from ..jit import upload
from .surface_points import SurfacePoints


class PatchPoints:
    """Surface points sorted by patch, from which rays start at random.

    patches   [K]      indices of the patches that have points
    first     [K + 1]  where the points of each begin
    index              which points stand for patches, sorted
    """

    def __init__(self, points: SurfacePoints, patch_of_point: np.ndarray, n_patches: int):
        standing = standing_points(points, patch_of_point)
        # Rows of a sparse matrix: a counting sort.
        place = patch_of_point[standing], np.arange(len(standing))
        by_patch = coo_matrix((standing, place), (n_patches, len(standing))).tocsr()
        self.patches = np.flatnonzero(np.diff(by_patch.indptr))
        self.first = np.append(by_patch.indptr[self.patches], len(standing)).astype(np.uint32)
        self.index = by_patch.data
        self._points = points
        self._first = upload(mi.UInt32, self.first)
        self._index = upload(mi.UInt32, self.index)

    def sample(self, rank: mi.UInt32, u: mi.Float) -> mi.SurfaceInteraction3f:
        """A random point of the ``rank``-th patch, as an interaction from which rays can start."""
        first = dr.gather(mi.UInt32, self._first, rank)
        n_points = dr.gather(mi.UInt32, self._first, rank + 1) - first
        k = first + dr.minimum(mi.UInt32(u * mi.Float(n_points)), n_points - 1)
        return self._points.interaction(dr.gather(mi.UInt32, self._index, k))


def standing_points(points: SurfacePoints, patch_of_point: np.ndarray) -> np.ndarray:
    """Indices of the points that stand for patches.

    Where walks from the sensors have come to a patch, only their points stand for it: global lines
    also hit what no light reaches, such as the floor under a cupboard, which would darken the part
    of the patch that looks out.
    """
    has_patch, seen = patch_of_point >= 0, points.seen > 0
    visited = np.zeros(patch_of_point.max(initial=-1) + 2, dtype=bool)
    visited[patch_of_point[has_patch & seen]] = True
    return np.flatnonzero(has_patch & (seen | ~visited[patch_of_point]))
