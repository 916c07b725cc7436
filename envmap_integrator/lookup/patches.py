"""The coarse mesh: patches on hashed grids over the surface points of a scene.

A patch is a cell of a grid, restricted to one object and to normals of one dominant direction, so
that the two sides of a wall, and a book and the table under it, never share one. Large cells
choose how finely they are divided by how densely surface points lie in them: the number of patches
is bounded by a budget and doesn't depend on the number of triangles. The patch of a surface point
is found from its position, normal and shape alone, by two packed gathers without a loop.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..system.jit import mix

#: Parts of a patch that are told apart: the octants of its cell.
PARTS = 8
#: Entries of a bucket of the hash tables, read by one packed gather.
BUCKET = 4
#: Bits of an entry that don't belong to the fingerprint: of the large cells' table, which hold the
#: level, and of the patches'.
LEVEL_BITS, MARK_BITS = 4, 2
#: Marks of a patch: direct light is uneven over it, and it has been left out.
UNEVEN, DROPPED = 1, 2


@dataclass
class Cell:
    """The large cell that a place lies in.

    index        of the cell,
    patch_size   ... edge of the patches in it [world units],
    found        ... and whether there is one
    """

    index: mi.UInt32
    patch_size: mi.Float
    found: mi.Bool


@dataclass
class FoundPatch:
    """The patch that stands for a place.

    index   of the patch,
    found   ... and whether there is one: surfaces too small to have been hit have none
    even    whether direct light is even there: else the patch stands for indirect light alone
    own     index of the patch that the place itself lies in, P if there is none
    """

    index: mi.UInt32
    found: mi.Bool
    even: mi.Bool
    own: mi.UInt32


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

    def locate(
        self,
        p: mi.Point3f,
        normal: mi.Normal3f,
        object_id: mi.UInt32,
        active: mi.Bool | bool = True,
    ) -> Cell:
        """Look up the large cell of a surface point, on the side of its geometric normal."""
        identity = self.identity_of(normal, object_id)
        entry, found, cell = self._probe(self.levels, p, identity, mi.UInt32(0), LEVEL_BITS, active)
        level = entry & ((1 << LEVEL_BITS) - 1)
        return Cell(cell, self.size / mi.Float(mi.UInt32(1) << level), found)

    def find(
        self,
        p: mi.Point3f,
        normal: mi.Normal3f,
        object_id: mi.UInt32,
        cell: Cell,
        active: mi.Bool | bool = True,
        u: mi.Point2f | None = None,
    ) -> FoundPatch:
        """Look up the patch of a surface point in its cell.

        With ``u``, uniform in the unit square, the point is moved at random by up to half a patch
        along the surface: the expectation interpolates between patches, so their borders don't
        show. Where the moved point belongs to no patch (beyond an edge of the surface), the patch
        of the point itself is taken; where that one has been left out, there is none.
        """
        active, size = active & cell.found, cell.patch_size
        level = mi.UInt32(dr.log2(self.size / size) + 0.5)
        identity = self.identity_of(normal, object_id)
        marks, exists, own = self._probe(self.cells, p, identity, level, MARK_BITS, active)
        dropped = exists & ((marks & DROPPED) != 0)
        found = exists & ~dropped
        own_or_none = dr.select(exists, own, dr.opaque(mi.UInt32, self.count))
        if u is None:
            return FoundPatch(own, found, (marks & UNEVEN) == 0, own_or_none)

        frame = mi.Frame3f(normal)
        moved = p + size * (frame.s * (u.x - 0.5) + frame.t * (u.y - 0.5))
        # Low bits of u tilt the normal too: curved surfaces change dominant direction smoothly.
        v = mi.Point2f(256 * u.x - dr.floor(256 * u.x), 256 * u.y - dr.floor(256 * u.y))
        tilted = normal + 0.4 * (frame.s * (v.x - 0.5) + frame.t * (v.y - 0.5))
        around = self.identity_of(tilted, object_id)
        # What has been left out isn't served by its neighbours: it's unlike them.
        entry, hit, patch = self._probe(
            self.cells, moved, around, level, MARK_BITS, active & ~dropped
        )
        hit &= (entry & DROPPED) == 0
        even = ((marks | dr.select(hit, entry, 0)) & UNEVEN) == 0
        return FoundPatch(dr.select(hit, patch, own), found | hit, even, own_or_none)

    def part(self, p: mi.Point3f, size: mi.Float) -> mi.UInt32:
        """Which of its ``PARTS`` a point lies in, in a patch of edge ``size`` [world units]."""
        half = dr.floor((p - self.origin) * (2 / size))
        half = mi.Vector3u(mi.Vector3i(half) & 1)
        return half.x + 2 * half.y + 4 * half.z

    def identity_of(self, normal: mi.Normal3f, object_id: mi.UInt32) -> mi.UInt32:
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


def normal_direction(normal: mi.Normal3f) -> mi.UInt32:
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


def cell_hash(
    cell: mi.Vector3i, identity: mi.UInt32, level: mi.UInt32
) -> tuple[mi.UInt32, mi.UInt32]:
    """Two independent hashes of a cell: its slot and its fingerprint.

    Fingerprints aren't zero, also without the bits that a level takes in their place.
    """
    c = dr.reinterpret_array(mi.Vector3u, cell)
    name = identity * 16 + level
    slot = mix(c.x * 0x8DA6B343 + c.y * 0xD8163841 + c.z * 0xCB1AB31F + name * 0x9E3779B1)
    fingerprint = mix(c.x * 0xC2B2AE3D + c.y * 0x27D4EB2F + c.z * 0x165667B1 + name * 0x85EBCA77)
    return slot, fingerprint | (1 << LEVEL_BITS)
