"""The coarse mesh: patches on hashed grids over the surface points of a scene.

A patch is a cell of a grid, restricted to one object and to normals of one dominant direction, so
that the two sides of a wall, and a book and the table under it, never share one. Large cells
choose how finely they are divided by how densely surface points lie in them: the number of patches
is bounded by a budget and doesn't depend on the number of triangles. The patch of a surface point
is found from its position, normal and shape alone, by two packed gathers without a loop.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from ..jit import mix, opaque_point, upload
from .surface_points import ObjectIds, SurfacePoints

#: Edge of the large cells as a fraction of the diagonal of the box that holds most surface points
#: (more if the budget is small), and how often they may be halved.
LARGE_CELL = 1 / 32
MAX_LEVEL = 12
#: Points in a large cell from which on the box about them tells how much of it they fill.
BOXED = 8
#: Parts of a patch that are told apart: the octants of its cell.
PARTS = 8
#: Entries of a bucket of the hash tables, read by one packed gather.
BUCKET = 4
#: Bits of an entry that don't belong to the fingerprint: of the large cells' table, which hold the
#: level, and of the patches'.
_LEVEL_BITS, _MARK_BITS = 4, 2
#: Marks of a patch: direct light is uneven over it, and it has been left out.
_UNEVEN, _DROPPED = 1, 2


@dataclass(frozen=True)
class Patches:
    """Two hash tables: large cell → level of division, cell of that level → patch.

    A patch's index is the place of its entry in the table. An entry is a fingerprint of the cell;
    where a bucket overflows, the patch is left out (about one in 10⁴).

    origin      [3]              corner of the grids, world space
    size        [1]              edge of a large cell, world units
    levels      [4 * buckets]    fingerprint and level of each large cell, 0 where empty
    cells       [P]              fingerprint and marks of each patch, 0 where empty
    use_objects                  whether the object id tells cells apart (not with too many objects)
    """

    origin: mi.Point3f
    size: mi.Float
    levels: mi.UInt32
    cells: mi.UInt32
    use_objects: bool

    @property
    def count(self) -> int:
        """Number of patch indices P, used or not."""
        return dr.width(self.cells)

    def find_cell(self, p, normal, object_id, active=True):
        """Look up the large cell of an oriented surface point.

        Returns ``(cell, size, found)``: the index of the cell, the edge of the patches in it in
        world units, and whether there is such a cell.
        """
        identity = self._identity(normal, object_id)
        entry, found, cell = self._probe(
            self.levels, p, identity, mi.UInt32(0), _LEVEL_BITS, active
        )
        level = entry & ((1 << _LEVEL_BITS) - 1)
        return cell, self.size / mi.Float(mi.UInt32(1) << level), found

    def find(self, p, normal, object_id, size, active=True, u=None):
        """Look up the patch of an oriented surface point in a cell with patches of edge ``size``.

        Returns ``(patch, found, even, own)``. Surfaces too small to have been hit have no patch;
        where direct light isn't ``even``, the patch's irradiance stands for indirect light alone.
        ``own`` is the patch that the point itself lies in, P if there is none.

        With ``u``, uniform in the unit square, the point is moved at random by up to half a patch
        along the surface: the expectation interpolates between patches, so their borders don't
        show. Where the moved point belongs to no patch (beyond an edge of the surface), the patch
        of the point itself is taken; where that one has been left out, there is none.
        """
        level = mi.UInt32(dr.log2(self.size / size) + 0.5)
        identity = self._identity(normal, object_id)
        marks, exists, own = self._probe(self.cells, p, identity, level, _MARK_BITS, active)
        dropped = exists & ((marks & _DROPPED) != 0)
        found = exists & ~dropped
        own_or_none = dr.select(exists, own, dr.opaque(mi.UInt32, self.count))
        if u is None:
            return own, found, (marks & _UNEVEN) == 0, own_or_none

        frame = mi.Frame3f(normal)
        moved = p + size * (frame.s * (u.x - 0.5) + frame.t * (u.y - 0.5))
        # Low bits of u tilt the normal too: curved surfaces change dominant direction smoothly.
        v = mi.Point2f(256 * u.x - dr.floor(256 * u.x), 256 * u.y - dr.floor(256 * u.y))
        tilted = normal + 0.4 * (frame.s * (v.x - 0.5) + frame.t * (v.y - 0.5))
        around = self._identity(tilted, object_id)
        # What has been left out isn't served by its neighbours: it's unlike them.
        entry, hit, patch = self._probe(
            self.cells, moved, around, level, _MARK_BITS, active & ~dropped
        )
        hit &= (entry & _DROPPED) == 0
        even = ((marks | dr.select(hit, entry, 0)) & _UNEVEN) == 0
        return dr.select(hit, patch, own), found | hit, even, own_or_none

    def part(self, p, size) -> mi.UInt32:
        """Which of its parts a point lies in, in a patch of edge ``size``."""
        half = dr.floor((p - self.origin) * (2 / size))
        half = mi.Vector3u(mi.Vector3i(half) & 1)
        return half.x + 2 * half.y + 4 * half.z

    def _identity(self, normal, object_id):
        """What tells patches in the same cell apart."""
        direction = normal_direction(normal)
        return direction + object_id * 8 if self.use_objects else direction

    def _probe(self, table, p, identity, level, payload_bits, active):
        """Look for a cell in a table: ``(entry, found, index)``."""
        scale = mi.Float(mi.UInt32(1) << level) / self.size
        cell = mi.Vector3i(dr.floor((p - self.origin) * scale))
        slot, fingerprint = cell_hash(cell, identity, level)
        # As data: tables of other sizes compile nothing.
        bucket = slot & dr.opaque(mi.UInt32, dr.width(table) // BUCKET - 1)
        entries = dr.gather(mi.Vector4u, table, bucket, active)
        found, index, entry = mi.Bool(False), mi.UInt32(0), mi.UInt32(0)
        for i in range(BUCKET):
            match = active & (entries[i] >> payload_bits == fingerprint >> payload_bits)
            index = dr.select(match, bucket * BUCKET + i, index)
            entry = dr.select(match, entries[i], entry)
            found |= match
        return entry, found, index


def normal_direction(normal):
    """Dominant signed axis of a direction, 0 … 5.

    The frame is turned a little, so that 45 degree faces, common in buildings, don't fall on a tie.
    """
    n = mi.Vector3f(
        dr.dot(normal, mi.Vector3f(0.978, 0.163, -0.130)),
        dr.dot(normal, mi.Vector3f(-0.147, 0.981, 0.126)),
        dr.dot(normal, mi.Vector3f(0.148, -0.104, 0.983)),
    )
    a = dr.abs(n)
    axis = dr.select(a.x >= dr.maximum(a.y, a.z), mi.UInt32(0), dr.select(a.y >= a.z, 1, 2))
    component = dr.select(axis == 0, n.x, dr.select(axis == 1, n.y, n.z))
    return 2 * axis + dr.select(component < 0, mi.UInt32(1), mi.UInt32(0))


def cell_hash(cell, identity, level):
    """Two independent hashes of a cell: its slot and its fingerprint.

    Fingerprints aren't zero, also without the bits that a level takes in their place.
    """
    c = dr.reinterpret_array(mi.Vector3u, cell)
    name = identity * 16 + level
    slot = mix(c.x * 0x8DA6B343 + c.y * 0xD8163841 + c.z * 0xCB1AB31F + name * 0x9E3779B1)
    fingerprint = mix(c.x * 0xC2B2AE3D + c.y * 0x27D4EB2F + c.z * 0x165667B1 + name * 0x85EBCA77)
    return slot, fingerprint | (1 << _LEVEL_BITS)


def build_patches(
    points: SurfacePoints, object_ids: ObjectIds, budget: int, divided: np.ndarray | None = None
) -> tuple[Patches, np.ndarray, np.ndarray]:
    """Build the coarse mesh over ``points`` with about ``budget`` patches.

    ``divided`` tells how often each large cell [C] is divided beyond what its points suggest.
    Returns the patches and, of every point, the patch index and the large cell's [N], -1 where
    it has none.
    """
    if len(points) == 0:  # Nothing but mirrors and glass.
        empty = np.zeros(0, dtype=np.int64)
        return _no_patches(), empty, empty
    (low, _), extent = points.box, points.extent
    position, normal, object_id = points.places()
    size = extent * LARGE_CELL
    while True:
        # An irrational offset keeps walls, mostly at round coordinates, off the cell borders.
        patches = Patches(
            origin=opaque_point(low - size * np.array([0.3819, 0.4142, 0.2361])),
            size=dr.opaque(mi.Float, size),
            levels=mi.UInt32(0),
            cells=mi.UInt32(0),
            use_objects=object_ids.count * 8 <= budget,
        )
        identity = patches._identity(normal, object_id)
        key = cell_keys(patches, position, identity, mi.UInt32(0))
        large, cell_of_point, n_points = np.unique(key, return_inverse=True, return_counts=True)
        # Six directions of a hundred small objects may share the smallest grid there is.
        if len(large) <= max(budget // 2, 8) or size > 4 * extent:
            break
        size *= 2

    # ---- Large cells choose their level by how densely points lie in them ----
    n_patches = np.maximum(n_points * (budget / len(points)), 1)
    long, short = _filled(position, cell_of_point, n_points, size)
    edge = np.maximum(np.sqrt(long * short / n_patches), long / n_patches)
    level = np.round(-np.log2(np.clip(edge, 2.0**-MAX_LEVEL, 1)))
    payload = np.uint64((1 << _LEVEL_BITS) - 1)
    levels, index_of_large = _hash_table(large & ~payload)
    kept = index_of_large >= 0
    if divided is not None:
        level[kept] += divided[index_of_large[kept]]
    level = np.clip(level, 0, MAX_LEVEL).astype(np.uint64)
    levels[index_of_large[kept]] |= level[kept].astype(np.uint32)
    large_of_point = index_of_large[cell_of_point]

    # ---- Their cells are the patches ----
    level_of_point = upload(mi.UInt32, level[cell_of_point])
    key = cell_keys(patches, position, identity, level_of_point)
    cells, cell_of_point = np.unique(key, return_inverse=True)
    cells, patch_of_cell = _hash_table(cells & ~np.uint64((1 << _MARK_BITS) - 1))
    patches = replace(patches, levels=upload(mi.UInt32, levels), cells=upload(mi.UInt32, cells))
    return patches, patch_of_cell[cell_of_point], large_of_point


def _filled(position, cell_of_point, n_points, size) -> np.ndarray:
    """How long and how wide [2, C] the points in each large cell lie, over its edge ``size``.

    A house on a plain, or a toy in a room, fills little of a cell that suits its surroundings.
    """
    cell, n_cells = upload(mi.UInt32, cell_of_point), len(n_points)
    extents = []
    for x in position:
        low, high = dr.full(mi.Float, dr.inf, n_cells), dr.full(mi.Float, -dr.inf, n_cells)
        # By default, few cells would be copied for each thread, and their number be compiled in.
        dr.scatter_reduce(dr.ReduceOp.Min, low, x, cell, mode=dr.ReduceMode.Local)
        dr.scatter_reduce(dr.ReduceOp.Max, high, x, cell, mode=dr.ReduceMode.Local)
        extents.append(high - low)
    dr.eval(extents)
    longest_first = -np.sort([-extent.numpy() for extent in extents], axis=0)
    # n points at random leave a margin of 1 / (n + 1) on either side.
    filled = longest_first[:2] / size * (n_points + 1) / np.maximum(n_points - 1, 1)
    return np.where(n_points < BOXED, 1, np.minimum(filled, 1))


def drop(
    patches: Patches, patch_of_point: np.ndarray, dropped: np.ndarray
) -> tuple[Patches, np.ndarray]:
    """Leave out some patches [P]: paths that come there are traced on.

    Returns the remaining patches and the patch of every surface point [N], -1 where it has none.
    """
    cells = patches.cells.numpy() | np.where(dropped, np.uint32(_DROPPED), np.uint32(0))
    kept = (patch_of_point >= 0) & ~dropped[patch_of_point]
    return replace(patches, cells=upload(mi.UInt32, cells)), np.where(kept, patch_of_point, -1)


def mark_uneven(patches: Patches, uneven: np.ndarray) -> Patches:
    """Let some patches [P] stand for indirect light alone: shadow rays bring the direct light."""
    cells = patches.cells.numpy() | np.where(uneven, np.uint32(_UNEVEN), np.uint32(0))
    return replace(patches, cells=upload(mi.UInt32, cells))


def _no_patches() -> Patches:
    """A coarse mesh on which nothing is found."""
    bucket = dr.zeros(mi.UInt32, BUCKET)
    origin, size = opaque_point((0, 0, 0)), dr.opaque(mi.Float, 1)
    return Patches(origin, size, levels=bucket, cells=mi.UInt32(bucket), use_objects=False)


def cell_keys(patches: Patches, position, identity, level) -> np.ndarray:
    """Slot and fingerprint [N] of the cells of points, in one word."""
    scale = mi.Float(mi.UInt32(1) << level) / patches.size
    cell = mi.Vector3i(dr.floor((position - patches.origin) * scale))
    slot, fingerprint = cell_hash(cell, identity, level)
    return (slot.numpy().astype(np.uint64) << np.uint64(32)) | fingerprint.numpy()


def _hash_table(keys: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Put the fingerprints of keys into buckets; returns the table and the index of each key [K].

    The index is -1 where the bucket was full. Two buckets a key make that rare.
    """
    n_buckets = 1 << int(np.ceil(np.log2(2 * len(keys) + 1)))
    bucket = ((keys >> np.uint64(32)) & np.uint64(n_buckets - 1)).astype(np.int64)
    order = np.argsort(bucket, kind="stable")
    first = np.searchsorted(bucket[order], bucket[order])
    rank = np.empty(len(keys), dtype=np.int64)
    rank[order] = np.arange(len(keys)) - first
    index = np.where(rank < BUCKET, bucket * BUCKET + rank, -1)
    table = np.zeros(n_buckets * BUCKET, dtype=np.uint32)
    table[index[index >= 0]] = (keys[index >= 0] & np.uint64(0xFFFFFFFF)).astype(np.uint32)
    return table, index
