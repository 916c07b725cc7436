"""What the size of the patches does to the picture, and where they have to be smaller.

A patch has one irradiance. Where irradiance changes within it and light leaves one side of it for
the picture rather than the other (through a slot, say), that is wrong, however many rays are sent,
and the picture doesn't show it. Gather rays know: they start and end in known parts of patches.
What paths read where they end, less what was found by the rays that start there, weighted by how
much the picture hangs on it, is the error of the picture by the size of the patches, to first
order; its sum over the cells of the coarse mesh tells where it comes from. (So does importance
refine meshes for radiosity; Smits, Arvo and Salesin 1992.)
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.sparse import csr_matrix

from ...lookup.patches import PARTS
from ...system.jit import mean_channel, upload
from ..coarse_mesh.patch_points import PatchPoints
from .gather import Blocks, GatherRays

#: Standard errors beyond which what a cell adds to the error is no chance.
SIGNIFICANCE = 3.0


@dataclass(frozen=True)
class Coarseness:
    """The error that the size of the patches leaves in the picture.

    bias    [1]  of the picture's brightness, over that brightness,
    doubt   [1]  ... and the standard error of this estimate
    steep   [C]  whether irradiance changes beyond doubt within the patches of a large cell, to the
                 picture's harm
    steep_bias  [1]  part of ``bias`` that comes from those cells
    """

    bias: float
    doubt: float
    steep: np.ndarray
    steep_bias: float

    @property
    def error(self) -> float:
        """The relative error, without sign, as far as it's beyond doubt."""
        return max(abs(self.bias) - self.doubt, 0.0)


def coarseness(
    rays: GatherRays,
    blocks: Blocks,
    table: np.ndarray,
    arriving: mi.Float,
    importance: np.ndarray,
    members: PatchPoints,
) -> Coarseness:
    """Compare what paths read with what is found where they read it.

    ``table`` [2 * P] is the irradiance, ``arriving`` [N * B] what each ray brings of it from the
    patch that it ends in, both the mean of the colour channels, and ``importance`` [K] how much the
    picture changes with the indirect irradiance of a patch.
    """
    n_used = len(members.patches)
    to_patch = csr_matrix((np.ones(len(rays)), (blocks.rank, np.arange(len(rays)))))

    # ---- Irradiance of each part of a patch, by the rays that start there ----
    count, total, indirect = (to_patch @ sums for sums in _by_part(rays, arriving))
    per_ray = 1 / np.maximum(count, 1)
    found = np.stack([per_ray * total, per_ray * indirect], axis=-1)

    # ---- What the picture reads there, by the rays that end there ----
    largest = max(table.max(), found.max(), 1e-30)
    share = importance / (blocks.count * rays.samples)
    ends = _Ends(rays, members, count > 0)
    weight = ends.weight(share[blocks.rank])
    excess = weight * (
        dr.gather(mi.Float, upload(mi.Float, table), rays.row)
        - dr.gather(mi.Float, upload(mi.Float, found), 2 * ends.slot + (rays.row & 1), ends.known)
    )
    # Throughputs of a block come to 1 at most, see ``gather``.
    most = max(float(importance.sum()), 1e-30)
    by_patch, of_part, of_patch = _exact_sums(
        (excess, ends.rank, n_used + 1, 2 * most * largest),
        (weight, ends.slot, PARTS * (n_used + 1), most),
        (weight, ends.read_rank, n_used + 1, most),
    )
    by_patch = by_patch[:-1]

    # ---- How sure that is: by what a ray adds to it, as one of its part and one of its patch ----
    of_part = per_ray * of_part[: PARTS * n_used].reshape(-1, PARTS)
    of_patch = of_patch[:-1] / np.maximum(count.sum(axis=1), 1)
    own = table[2 * members.patches + 1]
    squares = _squares(rays, arriving, blocks.rank, of_part - of_patch[:, None], own)
    variance = to_patch @ squares

    n_cells = members.n_cells
    known = members.cells >= 0
    by_cell, variance = (
        np.bincount(members.cells[known], x[known], n_cells) for x in (by_patch, variance)
    )
    steep = np.abs(by_cell) > SIGNIFICANCE * np.sqrt(variance)
    return Coarseness(
        bias=float(by_cell.sum()),
        doubt=float(np.sqrt(variance.sum())),
        steep=steep,
        steep_bias=float(by_cell[steep].sum()),
    )


class _Ends:
    """Where rays end, by the rank of patches among the K that hold points; K stands for others.

    rank       [N * B]  of the patch of that very place,
    slot       [N * B]  ... PARTS * rank + its part,
    known      [N * B]  ... and whether any ray starts in that part
    read_rank  [N * B]  of the patch that is read there
    """

    def __init__(self, rays: GatherRays, members: PatchPoints, known: np.ndarray):
        rank_of_patch = upload(mi.UInt32, members.rank_of_patch)
        known = np.vstack([known, np.zeros((1, PARTS), dtype=bool)])
        self._rays = rays
        self.rank = dr.gather(mi.UInt32, rank_of_patch, rays.place // PARTS)
        self.slot = PARTS * self.rank + rays.place % PARTS
        self.known = dr.gather(mi.UInt32, upload(mi.UInt32, known), self.slot) != 0
        self.read_rank = dr.gather(mi.UInt32, rank_of_patch, rays.row >> 1)

    def weight(self, share: np.ndarray) -> mi.Float:
        """How much the picture hangs on what each ray reads; ``share`` [B] is that of its block.

        Nothing is known of a part in which no ray starts.
        """
        weight = mean_channel(self._rays.weight)
        weight *= dr.repeat(upload(mi.Float, share), self._rays.samples)
        return dr.select(self.known, weight, 0)


@dr.syntax
def _by_part(rays: GatherRays, arriving: mi.Float) -> list[np.ndarray]:
    """Sums [3, B, PARTS] over the rays of each block that start in each part of their patch.

    Of their number, and of the total and the indirect irradiance that they bring.
    """
    first = dr.arange(mi.UInt32, len(rays)) * dr.opaque(mi.UInt32, rays.samples)
    end = first + dr.opaque(mi.UInt32, rays.samples)
    count = [mi.Float(0) for _ in range(PARTS)]
    total = [mi.Float(0) for _ in range(PARTS)]
    indirect = [mi.Float(0) for _ in range(PARTS)]
    k = mi.UInt32(first)
    while dr.hint(k < end, exclude=[rays, arriving], label="Parts of a patch"):
        part = dr.gather(mi.UInt32, rays.start, k) % PARTS
        others = dr.gather(mi.Float, rays.of_others, k) + dr.gather(mi.Float, arriving, k)
        both = others + dr.gather(mi.Float, rays.of_emitters, k)
        for i in range(PARTS):
            there = part == i
            count[i] += dr.select(there, mi.Float(1), 0)
            total[i] += dr.select(there, both, 0)
            indirect[i] += dr.select(there, others, 0)
        k += 1
    dr.eval(count, total, indirect)
    return [np.stack([x.numpy() for x in sums], axis=1) for sums in (count, total, indirect)]


def _squares(
    rays: GatherRays, arriving: mi.Float, rank: np.ndarray, weight: np.ndarray, mean: np.ndarray
) -> np.ndarray:
    """Sums [B] over the squares of what each ray's indirect light adds to the error.

    That counts by a ``weight`` [K, PARTS], and beyond the ``mean`` [K] of its patch.
    """
    rank = dr.repeat(upload(mi.UInt32, rank), rays.samples)
    slot = PARTS * rank + rays.start % PARTS
    beyond = rays.of_others + arriving - dr.gather(mi.Float, upload(mi.Float, mean), rank)
    square = dr.square(dr.gather(mi.Float, upload(mi.Float, weight), slot) * beyond)
    dr.eval(square)
    return dr.block_sum(square, rays.samples).numpy().astype(np.float64)


def _exact_sums(*wanted: tuple[mi.Float, mi.UInt32, int, float]) -> list[np.ndarray]:
    """Sums [size] of values by index, the same however threads share the work.

    Of several ``(values, index, size, most)``, in one launch. In integers, of which ``most`` is
    what all absolute values come to at most: sums of real numbers depend on their order.
    """
    scales = [2.0 ** (60 - np.ceil(np.log2(most))) for *_, most in wanted]
    sums = [dr.zeros(mi.UInt64, size) for _, _, size, _ in wanted]
    for (values, index, *_), scale, sum_ in zip(wanted, scales, sums, strict=True):
        number = mi.Int64(mi.Float64(values) * dr.opaque(mi.Float64, scale))
        dr.scatter_add(sum_, mi.UInt64(number), index, mode=dr.ReduceMode.Direct)
    dr.eval(sums)
    return [sum_.numpy().view(np.int64) / scale for sum_, scale in zip(sums, scales, strict=True)]
