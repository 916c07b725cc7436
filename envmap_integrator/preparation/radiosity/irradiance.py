"""The radiosity pass: irradiance on the patches, by gathering (paper section 1, 2).

The radiosity system is solved over the records of gather rays for any number of bounces without
tracing another ray. Where the picture hangs on few rays that found light, more are sent.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.sparse.linalg import LinearOperator, gmres

from ...lookup.irradiance_cache import IrradianceCache
from ...lookup.lookup import Lookup
from ...system.jit import give_back, upload
from ...system.progress import stage
from ..coarse_mesh.mesh import CoarseMesh
from ..coarse_mesh.patch_points import PatchPoints
from .gather import FLOATS_PER_RAY, Blocks, GatherRays, block_mean, gather, without_growth
from .incidence import Incidence
from .noise import Noise, cache_noise
from .unknowns import Unknowns

#: Relative change of the irradiance at which the solution counts as converged, on the mean of all
#: patches: each by its own irradiance, as the sunlit outside of a house says nothing of its rooms.
TOLERANCE = 1e-5
#: Bounces that are followed one by one, those between tests of that (each makes the host wait), and
#: directions that the rest is searched in at a time, and how often at most.
MAX_BOUNCES, CHECK_EVERY, KRYLOV, CYCLES = 64, 4, 32, 8
#: What part of the further rays is sent at a time, and what sets the seeds apart.
MORE, SEED_STEP = (0.25, 0.75), 0x10001


@dataclass(frozen=True)
class Solution:
    """The irradiance cache, and what is known of it.

    cache           the irradiance
    noise           the error that it leaves in the brightness of pictures, None without patches
    escaped_share   [P]  what part of the second moment of the indirect light that a patch's rays
                    bring has come from no patch but through mirrors and glass, or off what has none
    steep           [C]  large cells whose patches must be smaller first: the solution is a sketch
    """

    cache: IrradianceCache
    noise: Noise | None
    escaped_share: np.ndarray
    steep: np.ndarray

    @property
    def relative_error(self) -> float:
        """``Noise.error``; 0 without patches, as paths are traced to their end."""
        return self.noise.error if self.noise else 0.0

    @property
    def size_error(self) -> float:
        """The part of it that the size of the patches brings, as far as it's beyond doubt."""
        return self.noise.coarseness.error if self.noise else 0.0


def solve_irradiance(
    scene: mi.Scene,
    lookup: Lookup,
    mesh: CoarseMesh,
    samples: int,
    more_rays: int = 0,
    may_divide: bool = False,
    seed: int = 0,
    members: PatchPoints | None = None,
) -> Solution:
    """Gather and solve for the irradiance of every patch.

    ``members`` are the surface points of the mesh, if they have been sorted already.
    ``samples`` rays start from each patch, a power of two, and up to about ``more_rays`` where the
    picture's error hangs on them; packets of wavelengths share them. If patches turn out to be too
    large, and ``may_divide``, it ends there. With E_d the direct and E_i the indirect irradiance, b
    the light that gather rays find outside the patches, and w the throughput with which they end in
    patch j, the solution fulfils E_i = mean(π b + w E(j)), where E(j) is E_d + E_i or E_i.
    """
    unknowns = Unknowns(members or PatchPoints(mesh))
    samples = max(samples // unknowns.packets, 1)
    n_patches = unknowns.packets * mesh.patches.count
    n_channels, n_used = len(mi.Spectrum()), len(unknowns)
    if n_used == 0:  # Nothing but mirrors and glass.
        table = dr.zeros(mi.Float, 2 * n_patches * n_channels)
        no_cell = np.zeros(dr.width(lookup.patches.levels), dtype=bool)
        cache = IrradianceCache.of(
            lookup.patches, table, dr.zeros(mi.Float, 2 * mesh.patches.count)
        )
        return Solution(cache, None, np.zeros(mesh.patches.count), no_cell)

    incidence = Incidence(mesh.points)

    def send(rank, seed):
        return gather(scene, lookup, unknowns, incidence, rank, samples, seed)

    rank = np.arange(n_used)
    for further in range(len(MORE) + 1):
        rays = send(rank, seed + further * SEED_STEP)
        blocks = Blocks(rank, n_used)
        rays = without_growth(rays, blocks, unknowns.patches, n_patches)
        cache = IrradianceCache(lookup.patches, _solve(n_patches, unknowns.patches, rays, blocks))
        noise = cache_noise(rays, blocks, cache, unknowns)
        steep = noise.steep & (may_divide and further < len(MORE))
        if further == len(MORE) or steep.any():
            break
        # The rays that asked for others don't count any longer: patches whose rays happened to miss
        # the light would stay dark while the lucky ones are put right.
        wanted = noise.blocks_wanted(int(MORE[further] * more_rays / samples), samples)
        if not wanted.any():
            break
        rank = np.repeat(np.arange(n_used), wanted)
    patches, n = unknowns.members.patches, mesh.patches.count
    escaped_share, error = np.zeros(n), np.zeros((n, 2))
    escaped_share[patches] = unknowns.by_patch(noise.escaped_share).mean(axis=1)
    of_packets = unknowns.by_patch(noise.of_irradiance)
    error[patches] = np.sqrt(np.square(of_packets).sum(axis=1)) / unknowns.packets  # Of their mean.
    cache = IrradianceCache.of(lookup.patches, cache.table, upload(mi.Float, error.ravel()))
    n_rays = dr.width(rays.row)
    del rays
    give_back(FLOATS_PER_RAY * n_rays)
    return Solution(cache, noise, escaped_share, steep)


def _solve(n_patches: int, patch: np.ndarray, rays: GatherRays, blocks: Blocks) -> mi.Float:
    """Solve E_i = escaped + mean(w E(row)), bounce by bounce; returns the irradiance table.

    What is left after ``MAX_BOUNCES``, in rooms that are almost white, is solved for at once.
    """
    direct, escaped = (dr.ravel(blocks.mean(x)) for x in (rays.direct, rays.escaped))
    dr.eval(direct, escaped)
    table = dr.zeros(mi.Float, 2 * n_patches * len(mi.Spectrum()))
    row = 2 * upload(mi.UInt32, patch)

    def store(direct, indirect):
        dr.scatter(table, dr.unravel(mi.Spectrum, direct + indirect), row)
        dr.scatter(table, dr.unravel(mi.Spectrum, indirect), row + 1)
        dr.eval(table)

    def bounce(direct, indirect):
        """What patches receive from each other."""
        store(direct, indirect)
        arriving = rays.weight * dr.gather(mi.Spectrum, table, rays.row)
        dr.eval(arriving)  # Once, not for every block sum.
        return dr.ravel(blocks.mean(block_mean(arriving, rays.samples)))

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
        system, light / scale, rtol=0, atol=TOLERANCE * np.sqrt(n), restart=KRYLOV, maxiter=CYCLES
    )
    if unsolved or np.any(scale * found < 0.99 * light):
        found = light / scale
    return upload(mi.Float, scale * found)
