"""Building the coarse mesh: which cells of the grids are patches (``lookup.patches``)."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np

from ...lookup.ids import ObjectIds
from ...lookup.patches import BUCKET, LEVEL_BITS, MARK_BITS, Patches, cell_hash
from ...system.grouping import grouped
from ...system.jit import opaque_point, upload
from .mesh import CoarseMesh
from .surface_points import SurfacePoints

#: Edge of the large cells as a fraction of the diagonal of the box that holds most surface points
#: (more if the budget is small), and how often they may be halved.
LARGE_CELL = 1 / 32
MAX_LEVEL = 12
#: Points in a large cell from which on the box about them tells how much of it they fill.
BOXED = 8


def build_mesh(
    points: SurfacePoints, object_ids: ObjectIds, budget: int, divided: np.ndarray | None = None
) -> CoarseMesh:
    """Build the coarse mesh over ``points`` with about ``budget`` patches.

    ``divided`` tells how often each large cell [C] is divided beyond what its points suggest. All
    points are taken to be in one space.
    """
    if len(points) == 0:  # Nothing but mirrors and glass.
        empty = np.zeros(0, dtype=np.int64)
        return CoarseMesh(points, _no_patches(), empty, empty, empty)
    extent = points.extent
    position, normal, object_id = points.places()
    size = extent * LARGE_CELL
    while True:
        # An irrational offset keeps walls, mostly at round coordinates, off the cell borders.
        patches = Patches(
            origin=opaque_point(points.corner - size * np.array([0.3819, 0.4142, 0.2361])),
            size=dr.opaque(mi.Float, size),
            levels=mi.UInt32(0),
            cells=mi.UInt32(0),
            use_objects=object_ids.count * 8 <= budget,
        )
        identity = patches.identity_of(normal, object_id)
        key = cell_keys(patches, position, identity, mi.UInt32(0))
        large = grouped(key)
        # Six directions of a hundred small objects may share the smallest grid there is.
        if len(large.keys) <= max(budget // 2, 8) or size > 4 * extent:
            break
        size *= 2
    n_points, cell_of_point = large.counts, large.index

    # ---- Large cells choose their level by how densely points lie in them ----
    n_patches = np.maximum(n_points * (budget / len(points)), 1)
    long, short = _filled(position, cell_of_point, n_points, size)
    edge = np.maximum(np.sqrt(long * short / n_patches), long / n_patches)
    level = np.round(-np.log2(np.clip(edge, 2.0**-MAX_LEVEL, 1)))
    payload = np.uint64((1 << LEVEL_BITS) - 1)
    levels, index_of_large = _hash_table(large.keys & ~payload)
    kept = index_of_large >= 0
    if divided is not None:
        level[kept] += divided[index_of_large[kept]]
    level = np.clip(level, 0, MAX_LEVEL).astype(np.uint64)
    levels[index_of_large[kept]] |= level[kept].astype(np.uint32)
    large_of_point = index_of_large[cell_of_point]

    # ---- Their cells are the patches ----
    level_of_point = upload(mi.UInt32, level[cell_of_point])
    key = cell_keys(patches, position, identity, level_of_point)
    small = grouped(key)
    cells, patch_of_cell = _hash_table(small.keys & ~np.uint64((1 << MARK_BITS) - 1))
    patches = replace(patches, levels=upload(mi.UInt32, levels), cells=upload(mi.UInt32, cells))
    space = np.zeros(len(points), dtype=np.int64)
    return CoarseMesh(points, patches, patch_of_cell[small.index], large_of_point, space)


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


def _no_patches() -> Patches:
    """A coarse mesh on which nothing is found."""
    bucket = dr.zeros(mi.UInt32, BUCKET)
    origin, size = opaque_point((0, 0, 0)), dr.opaque(mi.Float, 1)
    return Patches(origin, size, levels=bucket, cells=mi.UInt32(bucket), use_objects=False)


def cell_keys(
    patches: Patches, position: mi.Point3f, identity: mi.UInt32, level: mi.UInt32
) -> np.ndarray:
    """Slot and fingerprint [N] of the cells of points, in one word."""
    scale = mi.Float(mi.UInt32(1) << level) / patches.size
    cell = mi.Vector3i(dr.floor((position - patches.origin) * scale))
    slot, fingerprint = cell_hash(cell, identity, level)
    return ((mi.UInt64(slot) << 32) | mi.UInt64(fingerprint)).numpy()


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
