"""How uncertain the irradiance cache leaves the picture, and which patches deserve more rays.

Gather rays are few; what they miss makes whole walks of light too dark, and the picture doesn't
show it: it is smooth, and wrong. An adjoint solution tells how much the picture hangs on each
patch, after any number of bounces; with the scatter of what the patch's own rays found, it gives
the error of the picture (a dual weighted residual; Becker and Rannacher 2001).
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.sparse import csc_matrix, csr_matrix

from ...lookup.irradiance_cache import IrradianceCache
from ...system.grouping import grouped
from ...system.jit import mean_channel
from ..coarse_mesh.patch_points import PatchPoints
from .coarseness import Coarseness, coarseness
from .gather import Blocks, GatherRays
from .unknowns import Unknowns

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

    chance           [1]  standard error of a picture's brightness, over that brightness: of the
                          sensor for which it is largest
    coarseness            what the size of the patches adds to it
    scatter          [U]  what a single ray of each unknown adds to that error, root mean square
                          over its patch's surroundings
    stake            [U]  share of the picture's brightness that passes through it, likewise
    of_irradiance    [U, 2]  W/m²: standard error of its total and its indirect irradiance, by the
                          chance of its rays alone, not of what they find on other patches
    count            [U]  blocks of rays so far
    escaped_share    [U]  see ``Solution``
    """

    chance: float
    coarseness: Coarseness
    scatter: np.ndarray
    stake: np.ndarray
    of_irradiance: np.ndarray
    count: np.ndarray
    escaped_share: np.ndarray

    @property
    def error(self) -> float:
        """Relative error [1] of the picture's brightness, by chance and by the size of patches."""
        return float(np.sqrt(self.chance**2 + self.coarseness.error**2))

    @property
    def steep(self) -> np.ndarray:
        """Large cells [C] whose patches must be smaller, lest the picture be wrong."""
        coarse = self.coarseness
        return coarse.steep & (abs(coarse.steep_bias) > max(TARGET, coarse.doubt))

    def blocks_wanted(self, most: int, samples: int) -> np.ndarray:
        """How many new blocks [U] of ``samples`` rays each unknown should have, ``most`` in all.

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
    unknowns: Unknowns,
) -> Noise:
    """Find out how uncertain a cache is that was solved from ``blocks`` of ``rays``."""
    samples, rank, packets = rays.samples, blocks.rank, unknowns.packets
    table = cache.mean_channel()
    irradiance = table[2 * unknowns.patches]
    # A patch's packets share its light.
    views = _views(unknowns.members, unknowns.by_patch(irradiance).mean(axis=1))
    views = np.repeat(views / packets, packets, axis=0)
    total, indirect = _importance(rays, blocks, unknowns, views)
    of_patches = mean_channel(rays.weight * dr.gather(mi.Spectrum, cache.table, rays.row))
    dr.eval(of_patches)
    # What is seen first gathers by rays of its own, as if it were patches.
    importance = unknowns.by_patch((indirect + views).sum(axis=1)).sum(axis=1)
    coarse = coarseness(
        rays.of_patches(packets),
        Blocks(rank // packets, len(importance)),
        table.reshape(-1, packets, 2).mean(axis=1).ravel(),
        of_patches,
        importance,
        unknowns.members,
    )

    # ---- Scatter within each block: rays k and k ^ step start in neighbouring directions ----
    step = 1 << (samples.bit_length() - 1) // 2
    sources, others = rays.of_emitters, rays.of_others + of_patches
    t, i = total[rank], indirect[rank]
    dr.eval(others)
    sums = [sources, others, dr.square(rays.of_others), dr.square(of_patches)]
    if samples > 1:
        lane = dr.arange(mi.UInt32, dr.width(others)) ^ dr.opaque(mi.UInt32, step)
        sources, others = (x - dr.gather(mi.Float, x, lane) for x in (sources, others))
    sums += sources * sources, others * others, 2 * sources * others
    *means, escaped, patched, s_s, o_o, s_o = _block_sums(sums, samples)
    block = sum(
        importance * mean[:, None] / samples for importance, mean in zip((t, i), means, strict=True)
    )
    s_s, o_o, s_o = (0.5 / samples**2 * x for x in (s_s, o_o, s_o))
    within = sum(
        a * moment[:, None]
        for a, moment in zip((t * t, i * i, t * i), (s_s, o_o, s_o), strict=True)
    )

    # ---- By patch: the scatter of its blocks, if there are several, as rays of one are stratified
    count = blocks.count
    share = 1 / count[rank]
    by_patch = csr_matrix((share, (rank, np.arange(len(rank)))), (len(count), len(rank)))
    between = np.square(block - (by_patch @ block)[rank])
    several = count > 1
    variance = by_patch @ np.where(several[rank, None], between, within)
    variance /= np.where(several, count - 1, 1)[:, None]
    chance = np.sqrt(variance.sum(axis=0).max())
    variance = variance.sum(axis=1)

    # ---- In its surroundings ----
    cell = grouped(unknowns.cells + 1).index

    def around(values):
        return (np.bincount(cell, values) / np.bincount(cell))[cell]

    own = by_patch @ np.column_stack([s_s + o_o + s_o, o_o])
    escaped, patched = (np.bincount(rank, x * share) for x in (escaped, patched))
    return Noise(
        chance=float(chance),
        coarseness=coarse,
        scatter=np.sqrt(around(variance * count * samples)),
        stake=around(indirect.sum(axis=1) * irradiance),
        of_irradiance=np.sqrt(np.maximum(own, 0) / count[:, None]),
        count=count,
        escaped_share=escaped / np.maximum(escaped + patched, 1e-30),
    )


def _views(members: PatchPoints, irradiance: np.ndarray) -> np.ndarray:
    """By what part [K, S] the brightness of each sensor's picture grows with a patch's irradiance.

    The part that the sensor sees of it first, by what that reflects; the pictures are those of all
    sensors that see light. Without sensors, there is one picture of all points.
    """
    points, n_patches = members.points, len(members.patches)
    rank = np.repeat(np.arange(n_patches), np.diff(members.first.astype(np.int64)))
    seen, reflects = points.seen[members.index], points.reflects[members.index]
    seen = np.where(points.bounce[members.index] == 0, seen, 0)
    if not seen.any():
        seen, reflects = np.ones(len(rank)), np.ones(len(rank))
    views = []
    for sensor in 1 + np.flatnonzero(np.bincount(seen.astype(np.int64))[1:]):
        view = np.bincount(rank[seen == sensor], reflects[seen == sensor], n_patches)
        brightness = view @ irradiance
        if brightness > 0:
            views.append(view / brightness)
    return np.column_stack(views) if views else np.zeros((n_patches, 1))


def _importance(rays, blocks, unknowns, views) -> tuple[np.ndarray, np.ndarray]:
    """By how much each picture changes with direct and indirect irradiance [U, S].

    A picture sends secondary rays of its own from what it sees first; they end where the gather
    rays from there do. From patch to patch, importance flows against the light.
    """
    samples, n_patches = rays.samples, len(unknowns)
    some = _spread(samples, min(samples, ADJOINT_RAYS))
    weight, row = (
        x.numpy().reshape(-1, samples)[:, some] for x in (mean_channel(rays.weight), rays.row)
    )
    rank = blocks.rank[:, None]
    weight = weight / (weight.shape[1] * blocks.count[rank])
    place = (2 * unknowns.rank_of_patch[row >> 1] + (row & 1)).ravel()
    if blocks.one_each:  # A column for each, in order: nothing needs to be sorted.
        first = np.arange(0, place.size + 1, row.shape[1])
        flow = csc_matrix((weight.ravel(), place, first), (2 * n_patches + 2, n_patches))
    else:
        places = place, np.broadcast_to(rank, row.shape).ravel()
        flow = csr_matrix((weight.ravel(), places), (2 * n_patches + 2, n_patches))

    def of_patches(importance):
        """Of their total and of their indirect irradiance; what follows stands for others."""
        total, indirect = importance[: 2 * n_patches].reshape(n_patches, 2, -1).transpose(1, 0, 2)
        return total, indirect

    asked = flow @ views
    importance = asked
    for _ in range(MAX_BOUNCES):
        previous, importance = importance, asked + flow @ sum(of_patches(importance))
        if np.abs(importance - previous).sum() <= CONVERGED * importance.sum():
            break
    total, of_indirect = of_patches(importance)
    return total, total + of_indirect


def _spread(samples: int, count: int) -> np.ndarray:
    """Numbers [count] of rays of a block that are spread as evenly as all: both powers of two.

    Rays have the numbers k and the directions (k / samples, k with its bits reversed): one of each
    ``samples / count`` in a row, each time another one, in the order of reversed bits.
    """
    step = samples // count
    bits = max(step.bit_length() - 1, 0)
    i = np.arange(count)
    within = sum(((i >> b) & 1) << (bits - 1 - b) for b in range(bits))
    return step * i + within


def _block_sums(values: list[mi.Float], samples: int) -> list[np.ndarray]:
    dr.eval(values)
    sums = [dr.block_sum(value, samples) for value in values]
    dr.eval(sums)
    return [each.numpy().astype(np.float64) for each in sums]
