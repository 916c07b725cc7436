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

import numpy as np

from ...lookup.patches import PARTS
from ...system.jit import mean_channel
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
    def squared_error(self) -> float:
        """Square of the relative error, as far as it's beyond doubt."""
        return max(abs(self.bias) - self.doubt, 0.0) ** 2


def coarseness(
    rays: GatherRays,
    blocks: Blocks,
    table: np.ndarray,
    arriving: np.ndarray,
    importance: np.ndarray,
    members: PatchPoints,
    n_cells: int,
) -> Coarseness:
    """Compare what paths read with what is found where they read it.

    ``table`` [2 * P] is the irradiance, ``arriving`` [N * B] what each ray brings of it from the
    patch that it ends in, both the mean of the colour channels, and ``importance`` [K] how much the
    picture changes with the indirect irradiance of a patch.
    """
    n_patches = len(table) // 2 + 1  # The last stands for none.
    start, place, row = (x.numpy().astype(np.int64) for x in (rays.start, rays.place, rays.row))
    weight = mean_channel(rays.weight).numpy().astype(np.float64)
    read = table[row]
    indirect = rays.of_others.numpy() + arriving
    total = indirect + rays.of_sources.numpy()

    # ---- Irradiance of each part of a patch, by the rays that start there ----
    n_rays = np.bincount(start, minlength=PARTS * n_patches)
    per_ray = 1 / np.maximum(n_rays, 1)
    found = np.column_stack(
        [per_ray * np.bincount(start, x, PARTS * n_patches) for x in (total, indirect)]
    )

    # ---- What the picture reads there, by the rays that end there ----
    share = importance[blocks.rank] / (blocks.count[blocks.rank] * rays.samples)
    weight *= np.repeat(share, rays.samples)
    weight[n_rays[place] == 0] = 0  # Nothing is known of a part in which no ray starts.
    excess = weight * (read - found[place, row & 1])
    patch = place // PARTS
    cell_of_patch = np.full(n_patches, -1)
    cell_of_patch[members.patches] = members.cells
    by_patch = np.bincount(patch, excess, n_patches)

    # ---- How sure that is: by what a ray adds to it, as one of its part and one of its patch ----
    of_part = per_ray * np.bincount(place, weight, PARTS * n_patches)
    of_patch = np.bincount(row >> 1, weight, n_patches) / np.maximum(
        n_rays.reshape(-1, PARTS).sum(axis=1), 1
    )
    adds = (of_part[start] - of_patch[start // PARTS]) * (indirect - table[1::2][start // PARTS])
    variance = np.bincount(start // PARTS, np.square(adds), n_patches)

    known = cell_of_patch >= 0
    by_cell, variance = (
        np.bincount(cell_of_patch[known], x[known], n_cells) for x in (by_patch, variance)
    )
    steep = np.abs(by_cell) > SIGNIFICANCE * np.sqrt(variance)
    return Coarseness(
        bias=float(by_cell.sum()),
        doubt=float(np.sqrt(variance.sum())),
        steep=steep,
        steep_bias=float(by_cell[steep].sum()),
    )
