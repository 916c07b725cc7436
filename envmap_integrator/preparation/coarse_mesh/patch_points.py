"""The surface points that stand for each patch."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property

import drjit as dr
import mitsuba as mi
import numpy as np

from ...lookup.patches import MARK_BITS, PARTS
from ...system.grouping import grouped
from ...system.jit import upload
from .mesh import CoarseMesh

#: Parts of the box about a patch's points along each axis in which rays start equally often.
STRATA = 4


class PatchPoints:
    """Surface points sorted by patch, from which rays start at random.

    patches   [K]      indices of the patches that have points
    first     [K + 1]  where the points of each begin
    index              which points stand for patches, sorted
    cells     [K]      large cell of each patch, -1 if it has none
    n_cells            number C of large cells in the mesh
    keys      [K]      hashes of the places of the patches, which random numbers go by: they stay
                       the same where nothing moves, whatever does elsewhere
    points             all surface points
    """

    def __init__(self, mesh: CoarseMesh):
        standing = np.flatnonzero(mesh.patch_of_point >= 0)
        by_patch = grouped(mesh.patch_of_point[standing])
        index = standing[by_patch.order]
        position = mesh.points.position.take(index, axis=0)
        by_part = grouped(_parts(position, by_patch.first))
        n_parts = np.bincount(by_part.keys // STRATA**3, minlength=len(by_patch.keys))
        self._set(mesh, by_patch.keys, index[by_part.order], n_parts, by_part.counts)

    def _set(self, mesh, patches, index, n_parts, n_points) -> None:
        """``n_parts`` [K] of each patch hold points, ``n_points`` of them each."""
        self._mesh, self.points = mesh, mesh.points
        self.n_cells = dr.width(mesh.patches.levels)
        self.patches, self.index = patches, index
        self.keys = mesh.patches.cells.numpy()[patches] >> np.uint32(MARK_BITS)
        self._n_parts, self._n_points = n_parts, n_points
        first_part, first_of_part = (np.append(0, np.cumsum(n)) for n in (n_parts, n_points))
        self.first = first_of_part[first_part].astype(np.uint32)
        self.cells = mesh.cell_of_point[index[self.first[:-1]]]
        self._first_part = upload(mi.UInt32, first_part)
        self._first_of_part = upload(mi.UInt32, first_of_part)
        self._index = upload(mi.UInt32, index)

    def only(self, mesh: CoarseMesh) -> PatchPoints:
        """Those of the same mesh from which some patches have been dropped since."""
        kept = mesh.patch_of_point[self.index[self.first[:-1]]] >= 0
        part_kept = np.repeat(kept, self._n_parts)
        n_points = self._n_points[part_kept]
        index = self.index[np.repeat(part_kept, self._n_points)]
        fewer = PatchPoints.__new__(PatchPoints)
        fewer._set(mesh, self.patches[kept], index, self._n_parts[kept], n_points)
        return fewer

    @cached_property
    def parts(self) -> mi.UInt32:
        """Which of the ``PARTS`` of its patch each surface point [N] lies in."""
        parts = self._mesh.parts()
        dr.eval(parts)
        return parts

    @cached_property
    def rank_of_patch(self) -> np.ndarray:
        """Place [P + 1] of each patch in ``patches``, K of others; the last stands for none."""
        rank = np.full(self._mesh.patches.count + 1, len(self.patches))
        rank[self.patches] = np.arange(len(self.patches))
        return rank

    def sample(self, rank: mi.UInt32, u: mi.Float) -> mi.UInt32:
        """Index of a random surface point of the ``rank``-th patch.

        Each part of the patch that has points is as likely as another: walks come to one side of it
        a hundred times as often as to the other where they look through a slit.
        """
        part, u = _among(self._first_part, rank, u)
        k, _ = _among(self._first_of_part, part, u)
        return dr.gather(mi.UInt32, self._index, k)


def _parts(position: np.ndarray, first: np.ndarray) -> np.ndarray:
    """Number of the part of a patch in which each point [N] lies, ascending from patch to patch.

    The points are sorted by patch; ``first`` [K + 1] is where those of each begin.
    """
    rank = np.repeat(np.arange(len(first) - 1), np.diff(first))
    key = rank
    if len(key) == 0:
        return key
    for x in position.T.astype(np.float64):
        low, high = (f.reduceat(x, first[:-1]) for f in (np.minimum, np.maximum))
        scale = STRATA / np.maximum(high - low, np.finfo(np.float32).tiny)
        slice_ = (x - low[rank]) * scale[rank]
        key = STRATA * key + np.minimum(slice_.astype(np.int64), STRATA - 1)
    return key


def _among(first: mi.UInt32, group: mi.UInt32, u: mi.Float) -> tuple[mi.UInt32, mi.Float]:
    """One of the places of a group, all as likely, and what is left of the random number."""
    begin = dr.gather(mi.UInt32, first, group)
    n = dr.gather(mi.UInt32, first, group + 1) - begin
    u *= mi.Float(n)
    k = dr.minimum(mi.UInt32(u), n - 1)
    return begin + k, u - mi.Float(k)


def only_standing(mesh: CoarseMesh) -> CoarseMesh:
    """The mesh with only those of a patch's surface points that stand for it.

    In the parts of a patch that walks from the sensors have come to, only their points stand for
    it: global lines also hit what no light reaches, such as the floor under a cupboard, which would
    darken what looks out.
    """
    points, patches, patch_of_point = mesh.points, mesh.patches, mesh.patch_of_point
    if len(points) == 0:  # Nothing but mirrors and glass.
        return mesh
    part = PARTS * patch_of_point + mesh.parts().numpy()
    has_patch, seen = patch_of_point >= 0, points.seen > 0
    visited = np.zeros(PARTS * patches.count, dtype=bool)
    visited[part[has_patch & seen]] = True
    standing = has_patch & (seen | ~visited[part])
    return replace(mesh, patch_of_point=np.where(standing, patch_of_point, -1))
