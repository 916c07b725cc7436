"""How uncertain the irradiance cache leaves the picture, and which patches deserve more rays.

Gather rays are few; what they miss makes whole walks of light too dark, and the picture doesn't
show it: it is smooth, and wrong. An adjoint solution tells how much the picture hangs on each
patch, after any number of bounces; with the scatter of what the patch's own rays found, it gives
the error of the picture (a dual weighted residual; Becker and Rannacher 2001).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.sparse import csr_matrix

from ..jit import mean_channel, upload
from .coarseness import Coarseness, coarseness
from .gather import Blocks, GatherRays
from .patch_points import PatchPoints

if TYPE_CHECKING:
    from .irradiance import IrradianceCache

#: Relative standard error of the picture's brightness that is good enough: two of them are 1 %.
TARGET = 0.005
#: Part of the further rays that goes by what is at stake, over the part that goes by what is known.
STAKE = 0.1
#: Rays of a block that the adjoint solution follows at most, change at which it has converged, and
#: bounces at most.
ADJOINT_RAYS, CONVERGED, MAX_BOUNCES = 32, 1e-3, 64


@dataclass(frozen=True)
class Noise:
    """What the picture owes to the chance of gather rays.

    chance           [1]  standard error of the picture's brightness, over that brightness
    coarseness            what the size of the patches adds to it
    scatter          [K]  what a single ray of each patch adds to that error, root mean square over
                          the patch's surroundings
    stake            [K]  share of the picture's brightness that passes through the patch, likewise
    count            [K]  blocks of rays so far
    escaped_share    [K]  see ``Solution``
    """

    chance: float
    coarseness: Coarseness
    scatter: np.ndarray
    stake: np.ndarray
    count: np.ndarray
    escaped_share: np.ndarray

    @property
    def error(self) -> float:
        """Relative error [1] of the picture's brightness, by chance and by the size of patches."""
        return float(np.sqrt(self.chance**2 + self.coarseness.squared_error))

    @property
    def steep(self) -> np.ndarray:
        """Large cells [C] whose patches must be smaller, lest the picture be wrong."""
        coarse = self.coarseness
        return coarse.steep & (abs(coarse.steep_bias) > max(TARGET, coarse.doubt))

    def blocks_wanted(self, most: int, samples: int) -> np.ndarray:
        """How many new blocks [K] of ``samples`` rays each patch should have, ``most`` in all.

        As many as bring the error to ``TARGET``, each where it lowers it most: in proportion to
        what a ray adds to the error (Neyman 1934). A few go by what is at stake, as patches whose
        rays have all missed the light don't know what they miss. None at all if there is no
        need.
        """
        total = self.scatter.sum()
        if self.chance <= TARGET or total == 0:
            return np.zeros(len(self.count), dtype=np.int64)
        needed = min((total / TARGET) ** 2 / samples, most)
        share = self.scatter / total + STAKE * self.stake / max(self.stake.sum(), 1e-30)
        return np.maximum(np.ceil(needed * share / share.sum()), 1).astype(np.int64)


def cache_noise(
    rays: GatherRays,
    blocks: Blocks,
    cache: IrradianceCache,
    members: PatchPoints,
    cell_of_point: np.ndarray,
) -> Noise:
    """Find out how uncertain a cache is that was solved from ``blocks`` of ``rays``."""
    samples, rank = rays.samples, blocks.rank
    table = cache.table.numpy().reshape(-1, len(mi.Spectrum())).mean(axis=1)
    irradiance = table[2 * members.patches]
    seen = _first_seen(members)
    brightness = max(float(seen @ irradiance), 1e-30)
    seen /= brightness
    total, indirect = _importance(rays, blocks, cache, members, seen)
    n_cells = dr.width(cache.patches.levels)
    of_patches = mean_channel(rays.weight * cache.irradiance(rays.row))
    dr.eval(of_patches)
    # What is seen first gathers by rays of its own, as if it were patches.
    importance = indirect + seen
    arriving = of_patches.numpy()
    coarse = coarseness(rays, blocks, table, arriving, importance, members, cell_of_point, n_cells)

    # ---- Scatter of each block: rays k and k ^ step start in neighbouring directions ----
    others = rays.of_others + of_patches
    per_ray = (
        dr.repeat(upload(mi.Float, importance[rank]), samples) for importance in (total, indirect)
    )
    value = next(per_ray) * rays.of_sources + next(per_ray) * others
    dr.eval(value)
    step = 1 << (samples.bit_length() - 1) // 2
    if samples > 1:
        lane = dr.arange(mi.UInt32, dr.width(value))
        value -= dr.gather(mi.Float, value, lane ^ dr.opaque(mi.UInt32, step))
    variance = 0.5 * _block_sum(dr.square(value), samples) / samples**2

    # ---- By patch, and in its surroundings ----
    share = 1 / blocks.count[rank]
    variance = np.bincount(rank, variance * share**2)
    cell = np.unique(cell_of_point[members.index[members.first[:-1]]], return_inverse=True)[1]

    def around(values):
        return (np.bincount(cell, values) / np.bincount(cell))[cell]

    squares = (_block_sum(dr.square(x), samples) for x in (rays.of_others, of_patches))
    escaped, patched = (np.bincount(rank, x * share) for x in squares)
    return Noise(
        chance=float(np.sqrt(variance.sum())),
        coarseness=coarse,
        scatter=np.sqrt(around(variance * blocks.count * samples)),
        stake=around(indirect * irradiance),
        count=blocks.count,
        escaped_share=escaped / np.maximum(escaped + patched, 1e-30),
    )


def _first_seen(members: PatchPoints) -> np.ndarray:
    """What part [K] of the surface that sensors see first lies in each patch.

    Without sensors, what part of all points.
    """
    points, n_patches = members.points, len(members.patches)
    rank = np.repeat(np.arange(n_patches), np.diff(members.first.astype(np.int64)))
    first = (points.seen[members.index] > 0) & (points.bounce[members.index] == 0)
    if not first.any():
        first[:] = True
    return np.bincount(rank[first], minlength=n_patches) / first.sum()


def _importance(rays, blocks, cache, members, seen) -> tuple[np.ndarray, np.ndarray]:
    """By how much the picture changes with the direct and the indirect irradiance [K] of a patch.

    The picture sends secondary rays of its own from what is ``seen`` [K] first; they end where the
    gather rays from there do. From patch to patch, importance flows against the light.
    """
    samples, n_patches = rays.samples, len(members.patches)
    some = np.s_[: min(samples, ADJOINT_RAYS)]
    weight, row = (
        x.numpy().reshape(-1, samples)[:, some] for x in (mean_channel(rays.weight), rays.row)
    )
    rank = blocks.rank[:, None]
    weight = weight / (weight.shape[1] * blocks.count[rank])
    place = row.ravel(), np.broadcast_to(rank, row.shape).ravel()
    flow = csr_matrix((weight.ravel(), place), (2 * cache.patches.count, n_patches))

    asked = flow @ seen
    importance = asked
    for _ in range(MAX_BOUNCES):
        total, of_indirect = importance.reshape(-1, 2)[members.patches].T
        previous, importance = importance, asked + flow @ (total + of_indirect)
        if np.abs(importance - previous).sum() <= CONVERGED * importance.sum():
            break
    total, of_indirect = importance.reshape(-1, 2)[members.patches].T
    return total, total + of_indirect


def _block_sum(value: mi.Float, samples: int) -> np.ndarray:
    dr.eval(value)
    return dr.block_sum(value, samples).numpy().astype(np.float64)
