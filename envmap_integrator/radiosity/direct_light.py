"""A survey of the direct light on the patches, before anything is decided about them."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..jit import upload
from ..rendering.ray_counts import Ray, count
from ..rendering.source_choice import Emitters, SourceChoice, alias_tables, by_weight
from .patch_points import PatchPoints
from .surface_points import SurfacePoints

#: Shadow rays per patch.
SAMPLES = 128
#: Part of the shadow rays that goes to emitters regardless of what has been found of them.
UNINFORMED = 0.1


@dataclass(frozen=True)
class DirectLight:
    """Samples of the irradiance from sources at surface points of K patches, N of each.

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
    points: SurfacePoints,
    patch_of_point: np.ndarray,
    n_patches: int,
    seed: int = 0,
) -> DirectLight:
    """Send ``SAMPLES`` shadow rays from random surface points of each patch."""
    members = PatchPoints(points, patch_of_point, n_patches)
    n = len(members.patches) * SAMPLES
    if n == 0:
        return DirectLight(members, mi.Float(), mi.UInt32(), mi.Point3f())
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed, n)
    si = members.sample(dr.arange(mi.UInt32, n) // SAMPLES, sampler.next_1d())
    choice = by_weight(emitters)
    ds, light = sample_irradiance(scene, choice, si, mi.UInt32(0), sampler.next_2d())
    irradiance = finite(dr.mean(light))
    emitter = emitters.index(ds.emitter, irradiance > 0)
    dr.eval(irradiance, emitter, si.p)
    return DirectLight(members, irradiance, emitter, si.p)


def choose_sources(
    emitters: Emitters, light: DirectLight, cell_of_point: np.ndarray, n_cells: int
) -> SourceChoice:
    """Probabilities of the emitters in each large cell, by the light found of them there.

    In proportion to the root mean square: to the mean, near lamps would get too few shadow rays.
    What doesn't shine on any patch keeps a small probability; ``sampling_weight`` scales all.
    """
    n, weights = emitters.count, emitters.weights
    if n < 2:
        return by_weight(emitters)
    cell = cell_of_point[light.members.index[light.members.first[:-1]]]
    emitter = light.emitter.numpy().astype(np.int64)
    # The irradiance has been divided by the weights.
    square = np.square(light.irradiance.numpy().astype(np.float64)) * weights[emitter]
    if not square.any():
        return by_weight(emitters)
    cell = np.repeat(cell, SAMPLES)
    inside = (cell >= 0) & (square > 0)
    # Most slots of the cells' hash table are empty, and share the last row.
    known = np.bincount(cell[inside], minlength=n_cells) > 0
    row_of_cell = np.where(known, np.cumsum(known) - 1, known.sum())
    slot = row_of_cell[cell[inside]] * n + emitter[inside]
    found = np.bincount(slot, square[inside], (known.sum() + 1) * n).reshape(-1, n)
    found[-1] = np.bincount(emitter, square, n)
    found = np.sqrt(found)
    found /= found.sum(axis=1, keepdims=True)
    probability = (1 - UNINFORMED) * found + UNINFORMED * weights
    table = upload(mi.Float, alias_tables(probability))
    return SourceChoice(emitters, table, upload(mi.UInt32, row_of_cell))


def sample_irradiance(scene, choice, si, row, u):
    """One sample of the irradiance [W/m²] from sources at a point: ``(ds, irradiance)``."""
    ds, weight = choice.sample_direction(si, row, u, True)
    cosine = dr.maximum(dr.dot(si.sh_frame.n, ds.d), 0)
    light = weight * dr.select(dr.dot(si.n, ds.d) > 0, cosine, 0)
    active = (ds.pdf != 0) & (dr.max(light) > 0)
    ray = si.spawn_ray_to(ds.p)
    count(Ray.SHADOW, ray, active)
    active &= ~scene.ray_test(ray, active)
    return ds, dr.select(active, light, 0)


def finite(x):
    """Zero in place of infinities and NaN, which degenerate geometry may bring."""
    return dr.select(dr.isfinite(x), x, 0)
