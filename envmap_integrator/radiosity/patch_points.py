"""The surface points that stand for each patch."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..jit import upload
from .surface_points import SurfacePoints


class PatchPoints:
    """Surface points sorted by patch, from which rays start at random.

    patches   [K]      indices of the patches that have points
    first     [K + 1]  where the points of each begin
    index              which points stand for patches, sorted
    points             these points
    """

    def __init__(self, points: SurfacePoints, patch_of_point: np.ndarray, n_patches: int):
        order = standing_points(points, patch_of_point)
        order = order[np.argsort(patch_of_point[order], kind="stable")]
        patch = patch_of_point[order]
        first = np.flatnonzero(np.diff(patch, prepend=-1))
        self.patches = patch[first]
        self.first = np.append(first, len(order)).astype(np.uint32)
        self.index = order
        self.points = points.take(order)
        self._first = upload(mi.UInt32, self.first)
        self._position = upload(mi.Float, self.points.position)
        self._normal = upload(mi.Float, self.points.normal)
        self._shading_normal = upload(mi.Float, self.points.shading_normal)

    def sample(self, rank: mi.UInt32, u: mi.Float) -> mi.SurfaceInteraction3f:
        """A random point of the ``rank``-th patch, as an interaction from which rays can start."""
        first = dr.gather(mi.UInt32, self._first, rank)
        n_points = dr.gather(mi.UInt32, self._first, rank + 1) - first
        index = first + dr.minimum(mi.UInt32(u * mi.Float(n_points)), n_points - 1)
        si = dr.zeros(mi.SurfaceInteraction3f, dr.width(rank))
        si.p = dr.gather(mi.Point3f, self._position, index)
        si.n = dr.gather(mi.Normal3f, self._normal, index)
        si.sh_frame = mi.Frame3f(dr.gather(mi.Normal3f, self._shading_normal, index))
        si.t = 0
        return si


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
