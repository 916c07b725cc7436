"""Errors of pictures whose reference is noisy too.

Pictures are arrays ``[H, W, 3]`` of radiance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

Picture = NDArray[np.float32]

Thirds = tuple[Picture, Picture, Picture]
"""Independent pictures of a reference."""

REL_MSE_EPSILON = 0.01
"""Keeps black pixels from dominating: times the reference's squared mean."""


@dataclass(frozen=True)
class Estimate:
    """A value, and half the width of its 95 % confidence interval."""

    value: float
    margin: float


def rel_mse(picture: Picture, reference: Thirds, tile: int = 1) -> float:
    """relMSE = mean((I-R)² / (R² + ε·mean(R)²)) against the unknown noise-free reference R.

    The thirds A, B, C of the reference have independent errors, so (I-A)(I-B) has the expectation
    (I-R)²: no reference noise is counted as ours. (Near zero error it may come out negative.)
    C stands for R in the denominator, which weights the pixels: were it A's or B's mean, pixels
    where both happen to have missed rare light would count most, an error that no picture is free
    of. The result is the mean over the three choices of C. ``tile`` > 1 compares averages over
    tiles of that many pixels squared.
    """
    return _error_product(picture, picture, reference, tile)


def error_floor(pictures: list[Picture], reference: Thirds, tile: int = 1) -> float:
    """relMSE that is left of the mean of infinitely many such pictures.

    Two pictures of independent seeds share nothing but their bias: the mean over all pairs of
    (I-A)(J-B) is free of the noise of either. (With no bias it may come out negative.)
    """
    total, n = np.sum(pictures, axis=0, dtype=np.float64), len(pictures)
    own = sum(_error_product(p, p, reference, tile) for p in pictures)
    mean = total / n
    return (n * n * _error_product(mean, mean, reference, tile) - own) / (n * (n - 1))


def rel_mse_of_difference(picture: Picture, other: Picture) -> float:
    """relMSE of the difference of two pictures, relative to their mean."""
    mean = (picture.astype(np.float64) + other) / 2
    return float(np.mean((picture.astype(np.float64) - other) ** 2 / _scale(mean)))


def _error_product(i, j, reference, tile) -> float:
    i, j, *thirds = (tiles(p, tile).astype(np.float64) for p in (i, j, *reference))
    turns = (np.roll(range(3), turn) for turn in range(3))
    return float(
        np.mean([(i - thirds[a]) * (j - thirds[b]) / _scale(thirds[c]) for a, b, c in turns])
    )


def _scale(reference):
    return reference**2 + REL_MSE_EPSILON * reference.mean() ** 2


def tiles(picture: Picture, size: int) -> Picture:
    """Averages over squares of ``size`` pixels; what is left at the border is dropped."""
    height, width = (n // size * size for n in picture.shape[:2])
    blocks = picture[:height, :width].reshape(height // size, size, width // size, size, -1)
    return blocks.mean(axis=(1, 3))


def mean_bias(pictures: list[Picture], part_means: list[float]) -> Estimate:
    """Relative error of the picture's mean over independent seeds: Welch's t interval.

    ``part_means`` are means of independent, equally sampled parts of the reference.
    """
    ours = np.array([picture.mean(dtype=np.float64) for picture in pictures])
    theirs = np.array(part_means)
    scale = theirs.mean()
    interval = stats.ttest_ind(ours / scale, theirs / scale, equal_var=False).confidence_interval()
    return Estimate(
        value=float(ours.mean() / scale - 1), margin=float(interval.high - interval.low) / 2
    )


def estimate(values) -> Estimate:
    """Mean of independent values, with Student's t interval."""
    values = np.asarray(values, dtype=np.float64)
    margin = stats.t.ppf(0.975, len(values) - 1) * stats.sem(values) if len(values) > 1 else np.inf
    return Estimate(float(values.mean()), float(margin))


def signed_error(picture: Picture, reference: Picture) -> NDArray[np.float64]:
    """Error of luminance relative to the reference's, [H, W]."""
    weights = np.array([0.2126, 0.7152, 0.0722])
    ours, theirs = picture @ weights, reference @ weights
    return (ours - theirs) / np.sqrt(theirs**2 + REL_MSE_EPSILON * theirs.mean() ** 2)
