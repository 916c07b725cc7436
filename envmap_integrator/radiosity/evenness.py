"""Patches that light falls on too unevenly for one irradiance to stand for all of it."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np

from ..jit import upload
from .irradiance import finite, sample_irradiance
from .patch_points import PatchPoints
from .patches import Patches
from .surface_points import SurfacePoints

#: Shadow rays per patch of the test, and slices of the patch along each axis that are compared.
SAMPLES, SLICES = 128, 4
#: A patch is uneven if a slice of it gets this many times less or more direct light than all of it,
#: beyond doubt: by this many standard errors, where this many samples should have found light.
CONTRAST, SIGNIFICANCE, MIN_LIT = 2.0, 4.0, 6.0


def drop_uneven(
    scene: mi.Scene,
    patches: Patches,
    points: SurfacePoints,
    patch_of_point: np.ndarray,
    seed: int = 0,
) -> tuple[Patches, np.ndarray]:
    """Drop patches across sharp edges of light: paths that come there are traced on instead.

    Such patches would leak: light on one side of a door frame into the dark room on the other.
    Returns the remaining patches and the patch of every surface point [N], -1 where it has none.
    """
    members = PatchPoints(points, patch_of_point, patches.count)
    n_patches = len(members.patches)
    if n_patches == 0:
        return patches, patch_of_point
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed, n_patches * SAMPLES)
    rank = dr.arange(mi.UInt32, n_patches * SAMPLES) // SAMPLES
    si = members.sample(rank, sampler.next_1d())
    _, light = sample_irradiance(scene, si, sampler.next_2d())
    irradiance = finite(dr.mean(light))
    dr.eval(irradiance, si.p)

    irradiance, position = irradiance.numpy().astype(np.float64), si.p.numpy().T
    patch = np.repeat(np.arange(n_patches), SAMPLES)
    mean, error, n = _statistics(irradiance, patch, n_patches)
    lit = np.bincount(patch, irradiance > 0, n_patches) / n
    uneven = np.zeros(n_patches, dtype=bool)
    for axis in range(3):
        x = position[:, axis].reshape(n_patches, SAMPLES)
        low, high = x.min(axis=1, keepdims=True), x.max(axis=1, keepdims=True)
        index = np.minimum(SLICES * (x - low) / np.maximum(high - low, 1e-30), SLICES - 1)
        slice_ = patch * SLICES + index.astype(np.int64).ravel()
        part, part_error, n = (
            values.reshape(n_patches, SLICES)
            for values in _statistics(irradiance, slice_, n_patches * SLICES)
        )
        contrast = (part > CONTRAST * mean[:, None]) | (mean[:, None] > CONTRAST * part)
        doubt = SIGNIFICANCE * np.hypot(part_error, error[:, None])
        certain = (np.abs(part - mean[:, None]) > doubt) & (n * lit[:, None] >= MIN_LIT)
        uneven |= (contrast & certain).any(axis=1)

    dropped = members.patches[uneven]
    cells = patches.cells.numpy()
    cells[dropped] = 0
    kept = ~np.isin(patch_of_point, dropped)
    return replace(patches, cells=upload(mi.UInt32, cells)), np.where(kept, patch_of_point, -1)


def _statistics(values: np.ndarray, group: np.ndarray, n_groups: int) -> tuple[np.ndarray, ...]:
    """Mean, its standard error, and number [G] of the values [N] in each group [N]."""
    n = np.bincount(group, minlength=n_groups)
    mean = np.bincount(group, values, n_groups) / np.maximum(n, 1)
    square = np.bincount(group, (values - mean[group]) ** 2, n_groups)
    return mean, np.sqrt(square / np.maximum(n - 1, 1) / np.maximum(n, 1)), n
