"""Mip-mapping of cube maps with masked texels (push-pull, Gortler et al. 1996)."""

from __future__ import annotations

import numpy as np

from ...lookup.cube import solid_angles


def build_levels(value: np.ndarray, weight: np.ndarray) -> list[np.ndarray]:
    """Fill masked texels and build all levels of a cube map.

    value    [6, R, R, K]  finest level
    weight   [6, R, R]     trust in each texel, 0 where it is masked
    Returns  [6, R_l, R_l, K] for every level, finest first. Levels are averages weighted by solid
             angle and trust (pull); texels without any trust take over from the coarser level
             (push), those of a whole face from the other faces.
    """
    values, weights = [value.copy()], [weight * solid_angles(value.shape[1])]
    while values[-1].shape[1] > 1:
        v, w = _halve(values[-1] * weights[-1][..., None]), _halve(weights[-1][..., None])
        values.append(np.divide(v, w, out=np.zeros_like(v), where=w > 0))
        weights.append(w[..., 0])

    total = weights[-1].sum()
    mean = (values[-1] * weights[-1][..., None]).sum(axis=(0, 1, 2)) / max(total, 1e-30)
    coarser = np.broadcast_to(mean, values[-1].shape)
    for level in reversed(range(len(values))):
        masked = weights[level] <= 0
        values[level][masked] = coarser[masked]
        coarser = values[level].repeat(2, axis=1).repeat(2, axis=2)
    return values


def _halve(x: np.ndarray) -> np.ndarray:
    return x[:, 0::2, 0::2] + x[:, 1::2, 0::2] + x[:, 0::2, 1::2] + x[:, 1::2, 1::2]
