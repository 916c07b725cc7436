"""A survey of the direct light on the patches, before anything is decided about them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from ...lookup.emitter_choice import EmitterChoice, Emitters
from ...lookup.patches import normal_direction
from ...system.grouping import grouped
from ...system.jit import mean_channel, upload, upload_vectors
from ...system.random_numbers import RandomNumbers
from ...system.ray_counts import Ray, count
from ...system.spectrum import random_wavelengths
from ..coarse_mesh.build import cell_keys
from ..coarse_mesh.mesh import CoarseMesh
from ..coarse_mesh.patch_points import PatchPoints
from .alias_tables import alias_tables, by_weight

#: Shadow rays per patch.
SAMPLES = 128
#: Part of the shadow rays that goes to emitters regardless of what has been found of them.
UNINFORMED = 0.1
#: Shadow rays per emitter from which on what they find of each tells emitters apart.
RAYS_PER_EMITTER = 8


@dataclass(frozen=True)
class DirectLight:
    """Samples of the irradiance from emitters at surface points of K patches, N of each.

    members      the patches and their surface points
    irradiance   [K * N]  W/m², mean of the colour channels, over the probability of the emitter
    emitter      [K * N]  index of the emitter it came from
    position     [K * N]
    """

    members: PatchPoints
    irradiance: mi.Float
    emitter: mi.UInt32
    position: mi.Point3f

    def __len__(self) -> int:
        """Number K of patches."""
        return len(self.members.patches)


def survey_direct_light(
    scene: mi.Scene,
    emitters: Emitters,
    mesh: CoarseMesh,
    seed: int = 0,
) -> DirectLight:
    """Send ``SAMPLES`` shadow rays from random surface points of each patch."""
    members = PatchPoints(mesh)
    n = len(members.patches) * SAMPLES
    if n == 0:
        return DirectLight(members, mi.Float(), mi.UInt32(), mi.Point3f())
    lane = dr.arange(mi.UInt32, n)
    member = lane // SAMPLES
    key = dr.gather(mi.UInt32, upload(mi.UInt32, members.keys), member)
    numbers = RandomNumbers.of_keys(seed, key, lane % SAMPLES)
    point = members.sample(member, numbers.next_1d())
    si = mesh.points.interaction(point)
    si.wavelengths = random_wavelengths(numbers)
    choice = by_weight(emitters)
    # In strata: neighbours send their rays to the same emitter, which is faster.
    u = numbers.next_2d()
    u.x = (mi.Float(lane % SAMPLES) + u.x) / SAMPLES
    ds, light = sample_irradiance(scene, choice, si, mi.UInt32(0), u)
    irradiance = finite(mean_channel(light))
    emitter = emitters.index(ds.emitter, irradiance > 0)
    dr.eval(irradiance, emitter, si.p)
    return DirectLight(members, irradiance, emitter, si.p)


def choose_emitters(
    emitters: Emitters,
    light: DirectLight,
    mesh: CoarseMesh,
) -> EmitterChoice:
    """Probabilities of the emitters in each large cell, by the light found of them there.

    In proportion to the root mean square: to the mean, near lamps would get too few shadow rays.
    What doesn't shine on any patch keeps a small probability; ``sampling_weight`` scales all.
    Cells with too few shadow rays to tell so many emitters apart share what has been found in
    their surroundings.
    """
    n, weights = emitters.count, emitters.weights
    if n < 2:
        return by_weight(emitters)
    lit = dr.compress(light.irradiance != 0)
    if len(lit) == 0:
        return by_weight(emitters)
    lit_by = dr.gather(mi.UInt32, light.emitter, lit)
    lit_square = dr.square(mi.Float64(dr.gather(mi.Float, light.irradiance, lit)))
    of_patch = lit // SAMPLES
    dr.eval(lit_by, lit_square, of_patch)
    lit_by = lit_by.numpy().astype(np.int64)
    # The irradiance has been divided by the weights.
    lit_square = lit_square.numpy() * weights[lit_by]
    of_all = np.bincount(lit_by, lit_square, n)

    # ---- Which rays left from each cell ----
    known = np.flatnonzero(light.members.cells >= 0)
    found = grouped(light.members.cells[known])
    cells, first = found.keys, known[found.order[found.first[:-1]]]
    point = light.members.index[light.members.first[first]]
    n_rays = SAMPLES * found.counts
    cell = np.full(len(light), -1)
    cell[known] = found.index
    cell = cell[of_patch.numpy()]
    if len(known) < len(light):
        lit_by, lit_square, cell = (x[cell >= 0] for x in (lit_by, lit_square, cell))
    n_lit = np.bincount(cell, minlength=len(cells))

    # ---- A row for the smallest surroundings of each cell that rays enough left from ----
    row = np.full(len(cells), -1)
    rows, n_rows = [], 0
    waiting = np.ones(len(cells), dtype=bool)
    for group in _surroundings(mesh, point):
        informed = np.bincount(group, n_rays)[group] >= RAYS_PER_EMITTER * n
        new = waiting & informed & (np.bincount(group, n_lit)[group] > 0)
        waiting &= ~informed
        used, place = np.unique(group[new], return_inverse=True)
        row[new] = n_rows + place
        rank = np.full(group.max(initial=0) + 1, -1)
        rank[used] = np.arange(len(used))
        slot = (rank * n)[group][cell] + lit_by
        there = slot >= 0
        squares = lit_square
        if not there.all():
            slot, squares = slot[there], lit_square[there]
        rows.append(np.bincount(slot, squares, len(used) * n).reshape(-1, n))
        n_rows += len(used)
        if not waiting.any():
            break
    # The last row is for the rest, and for the empty slots of the cells' hash table.
    rows.append(of_all[None])
    row_of_cell = np.full(dr.width(mesh.patches.levels), n_rows)
    row_of_cell[cells] = np.where(row < 0, n_rows, row)

    found = np.sqrt(np.concatenate(rows))
    found /= found.sum(axis=1, keepdims=True)
    probability = (1 - UNINFORMED) * found + UNINFORMED * weights
    table = upload(mi.Float, alias_tables(probability))
    return EmitterChoice(emitters, table, upload(mi.UInt32, row_of_cell))


def _surroundings(mesh: CoarseMesh, index: np.ndarray):
    """Ever larger groups of cells, of which ``index`` gives a surface point of each.

    First each cell is its own group; then those that face the same way in cubes of twice the edge,
    four times … Yields the group [C] of each cell.
    """
    yield np.arange(len(index))
    points, patches = mesh.points, mesh.patches
    position = upload_vectors(mi.Point3f, points.position[index])
    facing = normal_direction(upload_vectors(mi.Normal3f, points.normal[index]))
    size = patches.size[0]
    while size <= points.extent:
        size *= 2
        coarser = replace(patches, size=dr.opaque(mi.Float, size))
        keys = cell_keys(coarser, position, facing, mi.UInt32(0))
        yield np.unique(keys, return_inverse=True)[1]


def sample_irradiance(
    scene: mi.Scene,
    choice: EmitterChoice,
    si: mi.SurfaceInteraction3f,
    row: mi.UInt32,
    u: mi.Point2f,
) -> tuple[mi.DirectionSample3f, mi.Spectrum]:
    """One sample of the irradiance [W/m²] from emitters at a point: ``(ds, irradiance)``."""
    ds, weight = choice.sample_direction(si, row, u, True)
    cosine = dr.maximum(dr.dot(si.sh_frame.n, ds.d), 0)
    light = weight * dr.select(dr.dot(si.n, ds.d) > 0, cosine, 0)
    active = (ds.pdf != 0) & (dr.max(light) > 0)
    ray = si.spawn_ray_to(ds.p)
    count(Ray.SHADOW, ray, active)
    active &= ~scene.ray_test(ray, active)
    return ds, dr.select(active, light, 0)


def finite(x: mi.Float) -> mi.Float:
    """Zero in place of infinities and NaN, which degenerate geometry may bring."""
    return dr.select(dr.isfinite(x), x, 0)
