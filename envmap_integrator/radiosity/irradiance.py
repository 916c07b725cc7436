"""The radiosity pass: irradiance on the patches, by gathering (paper section 1, 2).

One batch of rays per patch measures the light transport between patches once, as in ray tracing
based radiosity (Wallace et al. 1987). The radiosity system is then solved over those records for
any number of bounces without tracing another ray.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.sparse.linalg import LinearOperator, gmres

from ..jit import give_back, mean_channel, mix, unit, upload
from ..progress import stage
from .direct_light import finite, sample_irradiance
from .patch_points import PatchPoints
from .patches import Patches
from .surface_points import SurfacePoints

if TYPE_CHECKING:
    from ..rendering.transport import Transport

#: Relative change of the irradiance at which the solution counts as converged, on the mean of all
#: patches: each by its own irradiance, as the sunlit outside of a house says nothing of its rooms.
TOLERANCE = 1e-5
#: Bounces that are followed one by one, those between tests of that (each makes the host wait), and
#: directions that the rest is searched in at a time.
MAX_BOUNCES, CHECK_EVERY, KRYLOV = 64, 4, 32
#: Steps of the R2 sequence (Roberts 2018).
R2 = (0.7548776662466927, 0.5698402909980532)
#: Gather rays per kernel launch: bounds memory.
MAX_LANES = 1 << 22
#: Floats that gather rays leave, and the iteration for them.
FLOATS_PER_RAY = 12


@dataclass(frozen=True)
class IrradianceCache:
    """Irradiance on the patches; each side of a surface has patches of its own.

    patches   the coarse mesh
    table     [2 * P * C]  W/m²: row 2p total, row 2p + 1 indirect irradiance of patch p, by C
                           colour channels
    """

    patches: Patches
    table: mi.Float

    def irradiance(self, row: mi.UInt32, active=True) -> mi.Spectrum:
        """Irradiance [W/m²] in a row of the table."""
        return dr.gather(mi.Spectrum, self.table, row, active)


def solve_irradiance(
    scene: mi.Scene,
    transport: Transport,
    points: SurfacePoints,
    patch_of_point: np.ndarray,
    cell_of_point: np.ndarray,
    samples: int,
    seed: int = 0,
) -> tuple[IrradianceCache, np.ndarray]:
    """Gather and solve for the irradiance of every patch.

    Also returns, of every patch [P], what part of the second moment of the indirect light that
    its rays bring has come from no patch but through mirrors and glass, or off what has no patches.

    ``samples`` rays start from random ones of a patch's surface points, with as many shadow rays;
    ``samples`` must be a power of two. With E_d the direct and E_i the indirect irradiance,
    b the light that gather rays find outside the patches, and w the throughput with which they
    end in patch j, the solution fulfils E_i = mean(π b + w E(j)), where E(j) is E_d + E_i or E_i.
    """
    members = PatchPoints(points, patch_of_point, transport.patches.count)
    cells = upload(mi.UInt32, cell_of_point[members.index[members.first[:-1]]])
    n_patches, launch = len(members.patches), max(MAX_LANES // samples, 1)
    parts = []
    with stage("Gathering irradiance", total=n_patches) as advance:
        for begin in range(0, n_patches, launch):
            end = min(begin + launch, n_patches)
            parts.append(_gather(scene, transport, members, cells, begin, end, samples, seed))
            advance(end - begin)
    if not parts:  # Nothing but mirrors and glass.
        n_channels = len(mi.Spectrum())
        table = dr.zeros(mi.Float, 2 * transport.patches.count * n_channels)
        return IrradianceCache(transport.patches, table), np.zeros(transport.patches.count)

    direct, escaped, escaped_square, weight, row = (
        _concatenate(part) for part in zip(*parts, strict=True)
    )
    patch = upload(mi.UInt32, members.patches)
    table = _solve(transport.patches.count, patch, direct, escaped, weight, row, samples)
    cache = IrradianceCache(transport.patches, table)
    patched_square = _second_moment(weight * cache.irradiance(row), samples)
    share = escaped_square / dr.maximum(escaped_square + patched_square, 1e-30)
    escaped_share = np.zeros(transport.patches.count)
    escaped_share[members.patches] = share.numpy()
    n_rays = dr.width(row)
    del parts, weight, row
    give_back(FLOATS_PER_RAY * n_rays)
    return cache, escaped_share


def _gather(scene, transport, members, cells, begin, end, samples, seed):
    """Trace the gather rays of the ``begin``-th … ``end``-th patch.

    Returns direct irradiance, π b and its second moment per patch, throughput and row per ray.
    """
    from ..rendering.transport import PathState, follow, mis_weight

    n_lanes = (end - begin) * samples
    sampler = mi.load_dict({"type": "independent"})
    seed += 1 + begin
    sampler.seed(seed, n_lanes)
    lane = dr.arange(mi.UInt32, n_lanes)
    rank = lane >> dr.opaque(mi.UInt32, int(np.log2(samples)))
    member = dr.opaque(mi.UInt32, begin) + rank
    k = lane & (dr.opaque(mi.UInt32, samples) - 1)
    si = members.sample(member, sampler.next_1d())

    # ---- Low-discrepancy numbers, rotated at random for each patch (Cranley-Patterson) ----
    u = _rotated(mi.Float(k) / dr.opaque(mi.Float, samples), mi.radical_inverse_2(k, 0), rank, seed)
    v = _rotated(mi.Float(k) * R2[0], mi.Float(k) * R2[1], rank, ~seed & 0xFFFFFFFF)

    # ---- Direction: cosine ----
    wo = mi.warp.square_to_cosine_hemisphere(u)
    pdf = mi.warp.square_to_cosine_hemisphere_pdf(wo)
    direction = si.to_world(wo)

    # ---- Direct light, by shadow rays and by the gather rays that hit a source ----
    sources = transport.sources
    source_row = sources.row(dr.gather(mi.UInt32, cells, member), True)
    ds, light = sample_irradiance(scene, sources, si, source_row, v)
    cosine = dr.maximum(dr.dot(si.sh_frame.n, ds.d), 0)
    direct = light * dr.select(ds.delta, 1, mis_weight(ds.pdf, cosine * dr.inv_pi))

    start = PathState(
        ray=si.spawn_ray(direction),
        depth=mi.UInt32(1),
        origin=mi.Interaction3f(si),
        source_row=source_row,
        pdf=pdf,
        specular=mi.Bool(False),
        bounded=mi.Bool(False),
        cluster=mi.UInt32(0),
        reach=mi.Float(dr.inf),
    )
    above = (dr.dot(si.n, direction) > 0) & (wo.z > 0)
    end_ = follow(scene, transport, sampler, start, above)
    direct += dr.pi * end_.direct
    escaped = dr.pi * (end_.radiance - end_.direct)

    def each(function, x):
        return type(x)(*(function(component) for component in x))

    direct, escaped, weight = (each(finite, x) for x in (direct, escaped, end_.weight))
    # Block sums evaluate what they sum up: without this, each of them would trace all rays anew.
    dr.eval(direct, escaped, weight, end_.row)
    escaped_square = _second_moment(escaped, samples)
    direct, escaped = (
        each(lambda c: dr.block_sum(c, samples) / samples, x) for x in (direct, escaped)
    )
    return direct, escaped, escaped_square, weight, end_.row


def _second_moment(light, samples) -> mi.Float:
    """Mean over the rays of each patch of the square of what they bring, over all channels."""
    square = dr.square(mean_channel(light))
    dr.eval(square)
    return dr.block_sum(square, samples) / samples


def _rotated(x, y, rank, seed) -> mi.Point2f:
    """A point set moved round the unit square, by another shift for every patch."""
    seed_ = dr.opaque(mi.UInt32, seed)
    bits = (mix(mix(2 * rank + axis) ^ seed_) for axis in range(2))
    shift = mi.Point2f(*map(unit, bits))
    point = mi.Point2f(x, y) + shift
    return point - dr.floor(point)


def _concatenate(parts):
    """One array of scalars or spectra in place of several."""
    if dr.depth_v(parts[0]) == 1:
        return dr.concat(parts)
    return type(parts[0])(*(dr.concat(components) for components in zip(*parts, strict=True)))


def _solve(n_patches, patch, direct, escaped, weight, row, samples):
    """Solve E_i = escaped + mean(w E(row)), bounce by bounce; returns the irradiance table.

    What is left after ``MAX_BOUNCES``, in rooms that are almost white, is solved for at once.
    """
    direct, escaped = dr.ravel(direct), dr.ravel(escaped)
    table = dr.zeros(mi.Float, 2 * n_patches * len(weight))

    def store(direct, indirect):
        dr.scatter(table, dr.unravel(mi.Spectrum, direct + indirect), 2 * patch)
        dr.scatter(table, dr.unravel(mi.Spectrum, indirect), 2 * patch + 1)
        dr.eval(table)

    def bounce(direct, indirect):
        """What patches receive from each other."""
        store(direct, indirect)
        arriving = weight * dr.gather(mi.Spectrum, table, row)
        dr.eval(arriving)  # Once, not for every block sum.
        return dr.ravel(mi.Spectrum(*(dr.block_sum(c, samples) / samples for c in arriving)))

    indirect = mi.Float(escaped)
    with stage("Solving irradiance"):
        for iteration in range(MAX_BOUNCES):
            previous, indirect = indirect, escaped + bounce(direct, indirect)
            if iteration % CHECK_EVERY:
                continue
            level = direct + indirect
            change = dr.sum(dr.select(level > 0, dr.abs(indirect - previous) / level, 0))
            dr.eval(indirect, change)
            if change[0] <= TOLERANCE * dr.width(level):
                break
        else:
            missing = escaped + bounce(direct, indirect) - indirect
            indirect += _all_bounces(lambda light: bounce(mi.Float(0), light), missing, indirect)
    store(direct, indirect)
    return table


def _all_bounces(bounce, light: mi.Float, scale: mi.Float) -> mi.Float:
    """Sum of ``light`` and what comes of it by all further bounces: GMRES (Saad and Schultz 1986).

    Errors are measured by ``scale``, the indirect light that each patch has already. Where a
    solution is less than ``light`` itself, or there is none, the sum is infinite, as patches
    reflect what they receive, or more by noise: only ``light`` is returned.
    """
    light, scale = (x.numpy().astype(np.float64) for x in (light, scale))
    scale = np.where(scale > 0, scale, 1)  # Nothing comes where nothing has come in many bounces.
    n = len(light)

    def remaining(x):
        return x - bounce(upload(mi.Float, scale * x)).numpy() / scale

    system = LinearOperator((n, n), remaining, dtype=np.float64)
    found, unsolved = gmres(
        system, light / scale, rtol=0, atol=TOLERANCE * np.sqrt(n), restart=KRYLOV, maxiter=2
    )
    if unsolved or np.any(scale * found < 0.99 * light):
        found = light / scale
    return upload(mi.Float, scale * found)
