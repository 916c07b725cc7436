"""Patches that light falls on too unevenly for one irradiance to stand for all of it."""

from __future__ import annotations

import numpy as np

from .direct_light import DirectLight
from .patches import Patches, drop

#: Slices of a patch along each axis that are compared.
SLICES = 4
#: A patch is uneven if a slice of it gets this many times less or more direct light than all of it,
#: beyond doubt: by this many standard errors, where this many samples should have found light.
CONTRAST, SIGNIFICANCE, MIN_LIT = 2.0, 4.0, 6.0


def drop_uneven(
    light: DirectLight, patches: Patches, patch_of_point: np.ndarray
) -> tuple[Patches, np.ndarray]:
    """Drop patches across sharp edges of light: paths that come there are traced on instead.

    Such patches would leak: light on one side of a door frame into the dark room on the other.
    Returns the remaining patches and the patch of every surface point [N], -1 where it has none.
    """
    n_patches, n_samples = light.irradiance.shape
    if n_patches == 0:
        return patches, patch_of_point
    irradiance = light.irradiance.ravel()
    patch = np.repeat(np.arange(n_patches), n_samples)
    mean, error, n = _statistics(irradiance, patch, n_patches)
    lit = np.bincount(patch, irradiance > 0, n_patches) / n
    uneven = np.zeros(n_patches, dtype=bool)
    for axis in range(3):
        x = light.position[..., axis]
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

    dropped = np.zeros(patches.count, dtype=bool)
    dropped[light.members.patches[uneven]] = True
    return drop(patches, patch_of_point, dropped)


def _statistics(values: np.ndarray, group: np.ndarray, n_groups: int) -> tuple[np.ndarray, ...]:
    """Mean, its standard error, and number [G] of the values [N] in each group [N]."""
    n = np.bincount(group, minlength=n_groups)
    mean = np.bincount(group, values, n_groups) / np.maximum(n, 1)
    square = np.bincount(group, (values - mean[group]) ** 2, n_groups)
    return mean, np.sqrt(square / np.maximum(n - 1, 1) / np.maximum(n, 1)), n
