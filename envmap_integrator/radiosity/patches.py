"""The coarse mesh: patches on a hashed octree over the surface points of a scene.

A patch is a cell of the octree, restricted to one object and to normals of one dominant
direction, so that the two sides of a wall, and a book and the table under it, never share one.
Cells are split where surface points are dense: the number of patches is bounded by a budget and
doesn't depend on the number of triangles. The patch of a surface point is found from its position,
normal and shape alone, in a bounded number of gathers.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..jit import opaque_point
from .surface_points import ObjectIds, SurfacePoints

#: Octree levels; level 0 cells have the edge ``Patches.size``, each level halves it.
LEVELS = 10
#: Largest patch edge as a fraction of the diagonal of the box that holds most surface points.
LARGEST = 1 / 32
#: Patches with fewer surface points than this aren't trusted with an irradiance.
MIN_POINTS = 2
#: Bits of the normal's dominant direction and of the level in the hash key.
_NORMAL_STRIDE, _OBJECT_STRIDE = 16, 128


@dataclass(frozen=True)
class Patches:
    """Hash table from (position, normal, object) to patch index.

    origin   [3]         corner of the grid, world space
    size     [1]         edge of a level 0 cell, world units
    table    [2 * M]     (fingerprint, patch index) pairs, M a power of two, linear probing
    mask     [1]         M - 1
    use_objects          whether the object id is part of the key (not with too many objects)
    count                number of patches P
    """

    origin: mi.Point3f
    size: mi.Float
    table: mi.UInt32
    mask: mi.UInt32
    use_objects: bool
    count: int

    @dr.syntax
    def find(self, p, normal, object_id, active=True):
        """Look up the patch of an oriented surface point.

        Returns ``(patch, size, found)``: the index, the edge of the patch in world units, and
        whether there is a patch. Surfaces too small to have been hit have none.
        """
        level = mi.UInt32(0)
        probe = mi.UInt32(0)
        patch = mi.UInt32(0)
        found = mi.Bool(False)
        searching = mi.Bool(active)
        side = normal_direction(normal)
        identity = side * _NORMAL_STRIDE
        if dr.hint(self.use_objects, mode="scalar"):
            identity += object_id * _OBJECT_STRIDE
        while dr.hint(searching, exclude=[self], label="Find patch"):
            slot, fingerprint = cell_hash(self.origin, self.size, p, identity, level)
            entry = dr.gather(mi.Vector2u, self.table, (slot + probe) & self.mask, searching)
            found = entry.x == fingerprint
            empty = entry.x == 0
            patch = entry.y
            probe = dr.select(empty, 0, probe + 1)
            level += dr.select(empty, mi.UInt32(1), mi.UInt32(0))
            searching &= ~found & (level < LEVELS)
        size = self.size / mi.Float(mi.UInt32(1) << dr.minimum(level, LEVELS - 1))
        return patch, size, found

    def find_jittered(self, p, normal, object_id, u, active=True):
        """As ``find``, at a point moved at random by half a patch along the surface.

        The expectation over ``u`` (uniform in the unit square) interpolates between patches, so
        their borders don't show. Where the moved point belongs to no patch (beyond an edge of the
        surface), the patch of the point itself is taken.
        """
        patch, size, found = self.find(p, normal, object_id, active)
        frame = mi.Frame3f(normal)
        shift = size * (frame.s * (u.x - 0.5) + frame.t * (u.y - 0.5))
        # Low bits of u tilt the normal too: curved surfaces change dominant direction smoothly.
        v = mi.Point2f(256 * u.x - dr.floor(256 * u.x), 256 * u.y - dr.floor(256 * u.y))
        tilted = normal + 0.4 * (frame.s * (v.x - 0.5) + frame.t * (v.y - 0.5))
        near, _, near_found = self.find(p + shift, tilted, object_id, found)
        return dr.select(near_found, near, patch), size, found


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


def cell_hash(origin, size, p, identity, level):
    """Slot and non-zero fingerprint of the cell that holds ``p`` on an octree level."""
    scale = mi.Float(mi.UInt32(1) << level) / size
    cell = dr.reinterpret_array(mi.Vector3u, mi.Vector3i(dr.floor((p - origin) * scale)))
    key = cell.x * 0x9E3779B1 + cell.y * 0x85EBCA77 + cell.z * 0xC2B2AE3D
    slot, fingerprint = mi.sample_tea_32(key, identity + level, 4)
    return slot, dr.maximum(fingerprint, 1)


def build_patches(
    points: SurfacePoints, object_ids: ObjectIds, budget: int
) -> tuple[Patches, np.ndarray]:
    """Build the coarse mesh over ``points`` with about ``budget`` patches.

    Returns the patches and the patch index of every point [N], -1 where it has none.
    """
    low, high = np.percentile(points.position, [2, 98], axis=0)
    size = max(float(np.linalg.norm(high - low)) * LARGEST, 1e-30)
    # An irrational offset keeps walls, mostly at round coordinates, off the cell borders.
    origin = points.position.min(axis=0) - size * np.array([0.3819, 0.4142, 0.2361])
    use_objects = object_ids.count * 8 <= budget
    identity = normal_direction(mi.Normal3f(points.normal.T)) * _NORMAL_STRIDE
    if use_objects:
        identity += mi.UInt32(points.object_id) * _OBJECT_STRIDE
    position = mi.Point3f(points.position.T)
    split_above = max(2 * len(points) // budget, MIN_POINTS)

    patch_of_point = np.full(len(points), -1, dtype=np.int64)
    keys = []
    n_patches = 0
    pending = np.arange(len(points))
    for level in range(LEVELS):
        slot, fingerprint = cell_hash(
            opaque_point(origin), mi.Float(size), position, identity, mi.UInt32(level)
        )
        key = (slot.numpy().astype(np.uint64) << 32) | fingerprint.numpy().astype(np.uint64)
        cells, cell_of_point, n_points = np.unique(
            key[pending], return_inverse=True, return_counts=True
        )
        leaf = (n_points <= split_above) | (level == LEVELS - 1)
        kept = leaf & (n_points >= MIN_POINTS)
        index = np.where(kept, n_patches + np.cumsum(kept) - 1, -1)
        is_leaf = leaf[cell_of_point]
        patch_of_point[pending[is_leaf]] = index[cell_of_point[is_leaf]]
        keys.append(cells[kept])
        n_patches += int(kept.sum())
        pending = pending[~is_leaf]
        if len(pending) == 0:
            break

    table, mask = _hash_table(np.concatenate(keys))
    patches = Patches(
        origin=opaque_point(origin),
        size=dr.opaque(mi.Float, size),
        table=mi.UInt32(table),
        mask=dr.opaque(mi.UInt32, mask),
        use_objects=use_objects,
        count=n_patches,
    )
    return patches, patch_of_point


def _hash_table(keys: np.ndarray) -> tuple[np.ndarray, int]:
    """Insert keys (slot << 32 | fingerprint), numbered by position, by linear probing."""
    size = 1 << int(np.ceil(np.log2(3 * len(keys) + 8)))
    table = np.zeros((size, 2), dtype=np.uint32)
    slot = (keys >> np.uint64(32)).astype(np.int64)
    pending = np.arange(len(keys))
    probe = 0
    while len(pending):
        position = (slot[pending] + probe) & (size - 1)
        free = table[position, 0] == 0
        # Several keys may want the same free slot: the first one gets it.
        _, first = np.unique(position, return_index=True)
        wins = np.zeros(len(pending), dtype=bool)
        wins[first] = True
        wins &= free
        winners = pending[wins]
        table[position[wins], 0] = (keys[winners] & np.uint64(0xFFFFFFFF)).astype(np.uint32)
        table[position[wins], 1] = winners
        pending = pending[~wins]
        probe += 1
    return table.ravel(), size - 1
