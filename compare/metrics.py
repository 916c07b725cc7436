"""Errors of pictures whose reference is noisy too.

Pictures are arrays ``[H, W, 3]`` of radiance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

Picture = NDArray[np.float32]

REL_MSE_EPSILON = 0.01
"""Keeps black pixels from dominating: times the reference's squared mean."""


@dataclass(frozen=True)
class Estimate:
    """A value, and half the width of its 95 % confidence interval."""

    value: float
    margin: float


def rel_mse(picture: Picture, half_a: Picture, half_b: Picture) -> float:
    """relMSE = mean((I-R)² / (R² + ε·mean(R)²)) against the unknown noise-free reference R.

    The two halves A, B of the reference have independent errors, so (I-A)(I-B) has the expectation
    (I-R)²: no reference noise is counted as ours. (Near zero error it may come out negative.)
    The denominator takes R = (A+B)/2.
    """
    a, b = half_a.astype(np.float64), half_b.astype(np.float64)
    reference = (a + b) / 2
    squared_error = (picture - a) * (picture - b)
    scale = reference**2 + REL_MSE_EPSILON * reference.mean() ** 2
    return float(np.mean(squared_error / scale))


def mean_bias(pictures: list[Picture], reference_parts: list[Picture]) -> Estimate:
    """Relative error of the picture's mean over independent seeds: Welch's t interval.

    ``reference_parts`` are independent equally sampled parts of the reference.
    """
    ours = np.array([picture.mean(dtype=np.float64) for picture in pictures])
    theirs = np.array([part.mean(dtype=np.float64) for part in reference_parts])
    scale = theirs.mean()
    interval = stats.ttest_ind(ours / scale, theirs / scale, equal_var=False).confidence_interval()
    return Estimate(
        value=float(ours.mean() / scale - 1), margin=float(interval.high - interval.low) / 2
    )


def signed_error(picture: Picture, reference: Picture) -> NDArray[np.float64]:
    """Error of luminance relative to the reference's, [H, W]."""
    weights = np.array([0.2126, 0.7152, 0.0722])
    ours, theirs = picture @ weights, reference @ weights
    return (ours - theirs) / np.sqrt(theirs**2 + REL_MSE_EPSILON * theirs.mean() ** 2)
