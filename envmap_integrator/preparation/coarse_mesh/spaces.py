"""Spaces that walls close off from each other: what is true in one room says nothing of the next.

A patch or a cluster on both sides of a wall, however thin, would let light through it.
"""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from ...lookup.ids import ObjectIds
from ...system.grouping import grouped
from ...system.jit import upload
from ...system.random_numbers import RandomNumbers
from ...system.ray_counts import Ray, count
from .mesh import CoarseMesh
from .surface_points import SurfacePoints

#: Pairs of points on walks that are tested for sight of each other.
PAIRS = 1 << 15
#: Points on walks that another point is tested against, until it sees one.
TRIES = 16
#: Cosine below which nothing is seen: by rounding, the two sides of a wall face each other.
GRAZING = 0.02
#: An unknown space, -1, in an array of Dr.Jit.
UNKNOWN = 0xFFFFFFFF
#: Places around each point from which patches are looked up, within a patch's size.
LOOKS = 16


def find_spaces(scene: mi.Scene, mesh: CoarseMesh, seed: int = 0) -> CoarseMesh:
    """The mesh with the space of every surface point.

    A walk stays in the space where it starts, which is the same for all walks of a sensor that
    start in sight of one place. Other walks are in the same one if they see each other. Other
    points are in that of a walk that they see, which is tested only for those that stand for
    patches. Without sensors, all is one space.
    """
    points = mesh.points
    walked = np.flatnonzero(points.seen)
    if len(walked) == 0:
        return mesh
    walk = points.seen.astype(np.int64)
    if points.start.any():
        starts = walk[walked] * (points.start.max() + 1) + points.start[walked]
        walk[walked] = 1 + grouped(starts).index
    space = np.where(walk > 0, 0, -1)
    sight = _Sight(scene, points)
    if walk.max() > 1:
        a, b = np.random.default_rng(seed).choice(walked, (2, PAIRS))
        linked = sight(upload(mi.UInt32, a), upload(mi.UInt32, b)).numpy()
        ends = walk[a[linked]], walk[b[linked]]
        n_nodes = int(walk.max()) + 1  # The first stands for no sensor.
        links = coo_matrix((np.ones(linked.sum()), ends), (n_nodes, n_nodes))
        space = connected_components(links, directed=False)[1][walk] - 1
    others = np.flatnonzero((mesh.patch_of_point >= 0) & (walk == 0))
    if len(others):
        space[others] = space[sight.first_seen(others, walked, seed)]
    return replace(mesh, space_of_point=space)


class _Sight:
    """Which surface points see each other."""

    def __init__(self, scene: mi.Scene, points: SurfacePoints):
        self._scene = scene
        self._points = points

    def __call__(self, a: mi.UInt32, b: mi.UInt32, active: mi.Bool | bool = True) -> mi.Bool:
        """Do the points of indices ``a`` and ``b`` see each other?"""
        a, b = self._points.interaction(a), self._points.interaction(b)
        d = dr.normalize(b.p - a.p)
        ray, back = a.spawn_ray(d), b.spawn_ray(-d)
        # Up to the very end: rays to a point stop short of it by more than a wall may be away.
        between = back.o - ray.o
        ray.maxt = dr.norm(between)
        ray.d = between / ray.maxt
        active = active & (dr.dot(d, a.n) > GRAZING) & (dr.dot(-d, b.n) > GRAZING)
        count(Ray.SURVEY, ray, active)
        return active & ~self._scene.ray_test(ray, active)

    def first_seen(self, points: np.ndarray, targets: np.ndarray, seed: int) -> np.ndarray:
        """For each of ``points``, the first of a few random ``targets`` that it sees.

        Takes and returns indices, a point's own where it saw none.
        """
        numbers = RandomNumbers.of_lanes(seed, len(points))
        return _first_seen(
            self, upload(mi.UInt32, points), upload(mi.UInt32, targets), len(targets), numbers
        ).numpy()


@dr.syntax
def _first_seen(sight, point, targets, n_targets, numbers):
    seen = mi.UInt32(point)
    n = dr.opaque(mi.UInt32, n_targets)
    tries = mi.UInt32(0)
    active = dr.full(mi.Bool, True, dr.width(point))
    while dr.hint(active, exclude=[sight, point, targets, n], label="Look for points on walks"):
        k = dr.minimum(mi.UInt32(numbers.next_1d() * mi.Float(n)), n - 1)
        target = dr.gather(mi.UInt32, targets, k, active)
        found = sight(point, target, active)
        seen = dr.select(found, target, seen)
        tries += 1
        active &= ~found & (tries < TRIES)
    return seen


def separate(scene: mi.Scene, object_ids: ObjectIds, mesh: CoarseMesh, seed: int = 0) -> CoarseMesh:
    """Drop patches that might bring light from one space to another.

    These are the ones in several spaces, the ones that aren't known to be in any, as what they
    look at might be closed off from all sensors, and the ones that are looked up from a space that
    isn't their own. In the usual case of a single space there are none of the last kind, whatever
    closed rooms and boxes no sensor comes to: what is left has been seen from the sensors' space.

    Points whose space isn't known, and those in large cells that lie in several, have no large cell
    in the mesh that it returns.
    """
    space = mesh.space_of_point
    standing = mesh.patch_of_point >= 0
    patch = mesh.patch_of_point[standing]
    space_of_patch = np.full(mesh.patches.count, -1)
    space_of_patch[patch] = space[standing]
    space_of_patch[patch[space_of_patch[patch] != space[standing]]] = -1
    dropped = space_of_patch < 0
    cell_of_point = np.where(space < 0, -1, mesh.cell_of_point)
    if space.max(initial=0) > 0:
        foreign, mixed = _look_around(scene, object_ids, mesh, space_of_patch, seed)
        dropped |= foreign
        cell_of_point = np.where(mixed[cell_of_point], -1, cell_of_point)
    return replace(mesh.without(dropped), cell_of_point=cell_of_point)


def _looked_at(scene, object_ids, patches, si, space_of_patch, numbers, active) -> mi.UInt32:
    """The space of the patch that a random ray from each point hits, ``UNKNOWN`` if none."""
    direction = mi.warp.square_to_cosine_hemisphere(numbers.next_2d())
    ray = si.spawn_ray(mi.Frame3f(si.n).to_world(direction))
    count(Ray.SURVEY, ray, active)
    hit = scene.ray_intersect(ray, active)
    normal, objects = dr.mulsign(hit.n, -dr.dot(hit.n, ray.d)), object_ids(hit)
    cell = patches.locate(hit.p, normal, objects, active & hit.is_valid())
    patch = patches.find(hit.p, normal, objects, cell)
    space = dr.gather(mi.UInt32, space_of_patch, patch.index, patch.found)
    return dr.select(patch.found, space, UNKNOWN)


def _look_around(scene, object_ids, mesh, space_of_patch, seed):
    """Which patches [P] are looked up from other spaces, which large cells [C] from several.

    Tested from all points: walks hardly come to the nooks by a wall, but paths of the renderer do.
    """
    points, patches, space = mesh.points, mesh.patches, mesh.space_of_point
    n_lanes = LOOKS * len(points)
    numbers = RandomNumbers.of_lanes(seed, n_lanes)
    lane = dr.arange(mi.UInt32, n_lanes) // LOOKS
    space_of_patch = upload(mi.UInt32, space_of_patch)
    si = points.interaction(lane)
    object_id = dr.gather(mi.UInt32, upload(mi.UInt32, points.object_id), lane)

    # ---- Where no walk came, a point is in the space of what it looks at ----
    own = dr.gather(mi.UInt32, upload(mi.UInt32, space), lane)
    seen = _looked_at(scene, object_ids, patches, si, space_of_patch, numbers, own == UNKNOWN)
    own = dr.select(own == UNKNOWN, seen, own)
    known = own != UNKNOWN

    # ---- Twice as far as the renderer jitters its look-ups, to be on the safe side ----
    near = patches.locate(si.p, si.n, object_id, known)
    u = numbers.next_2d()
    frame = mi.Frame3f(si.n)
    p = si.p + near.patch_size * (frame.s * (u.x - 0.5) + frame.t * (u.y - 0.5))
    cell = patches.locate(p, si.n, object_id, near.found)
    patch = patches.find(p, si.n, object_id, cell, u=numbers.next_2d())

    other = dr.gather(mi.UInt32, space_of_patch, patch.index, patch.found) != own
    foreign = dr.zeros(mi.Bool, patches.count)
    dr.scatter(foreign, mi.Bool(True), patch.index, patch.found & other)
    n_cells = dr.width(patches.levels)
    first = dr.full(mi.UInt32, int(space.max()) + 1, n_cells)
    last = dr.zeros(mi.UInt32, n_cells)
    dr.scatter_reduce(dr.ReduceOp.Min, first, own, cell.index, cell.found)
    dr.scatter_reduce(dr.ReduceOp.Max, last, own, cell.index, cell.found)
    dr.eval(foreign, first, last)
    return foreign.numpy(), first.numpy() < last.numpy()
