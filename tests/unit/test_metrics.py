"""Errors of pictures with known noise and known bias."""

from __future__ import annotations

import numpy as np
import pytest

from compare.metrics import (
    REL_MSE_EPSILON,
    error_floor,
    estimate,
    mean_bias,
    rel_mse,
    rel_mse_of_difference,
    tiles,
)

SHAPE = (64, 48, 3)
#: The scale of relMSE for a reference of 1 everywhere.
SCALE = 1 + REL_MSE_EPSILON


@pytest.fixture
def noise():
    """``noise(sigma)``: a picture of 1 with independent normal errors, another at each call."""
    generator = np.random.default_rng(0)
    return lambda sigma, mean=1.0: generator.normal(mean, sigma, SHAPE).astype(np.float32)


def standard_error(variance):
    return variance * np.sqrt(2 / np.prod(SHAPE))


def test_noise_of_the_reference_is_not_counted(noise):
    measured = rel_mse(noise(0.1), (noise(0.1), noise(0.1), noise(0.1)))
    assert measured == pytest.approx(0.01 / SCALE, abs=4 * standard_error(0.02))


def test_rare_light_that_a_reference_misses_is_no_error():
    """Noise of one bright sample in a hundred pixels, in the picture and in its reference."""
    generator = np.random.default_rng(1)

    def picture(n_samples):
        found = generator.binomial(n_samples, 0.01, (1024, 1024, 1)) / n_samples
        return (0.1 + 100 * found).astype(np.float32)

    reference = picture(64), picture(64), picture(64)
    exact = np.full((1024, 1024, 1), 1.1, np.float32)
    assert rel_mse(exact, reference) == pytest.approx(0, abs=0.1)


def test_half_the_variance_is_half_the_error(noise):
    exact = (np.ones(SHAPE, np.float32),) * 3
    ratio = rel_mse(noise(0.2), exact) / rel_mse(noise(0.2 / np.sqrt(2)), exact)
    assert ratio == pytest.approx(2, rel=0.1)


def test_floor_is_the_squared_bias(noise):
    pictures = [noise(0.1, mean=1.05) for _ in range(5)]
    floor = error_floor(pictures, (noise(0.05), noise(0.05), noise(0.05)))
    assert floor == pytest.approx(0.05**2 / SCALE, rel=0.2)


def test_floor_without_bias_is_zero(noise):
    floor = error_floor([noise(0.1) for _ in range(5)], (noise(0.05), noise(0.05), noise(0.05)))
    assert abs(floor) < 5 * standard_error(0.01)


def test_tiles_average_noise_but_not_bias(noise):
    one = np.ones(SHAPE, np.float32)
    exact = one, one, one
    assert rel_mse(noise(0.1), exact, tile=8) == pytest.approx(0.01 / 64 / SCALE, rel=0.5)
    assert rel_mse(1.1 * one, exact, tile=8) == pytest.approx(0.01 / SCALE, rel=1e-3)


def test_tiles_drop_what_is_left_over():
    picture = np.arange(5 * 7 * 3, dtype=np.float32).reshape(5, 7, 3)
    averaged = tiles(picture, 2)
    assert averaged.shape == (2, 3, 3)
    assert averaged[0, 0, 0] == picture[:2, :2, 0].mean()


def test_difference_of_pictures_gives_their_noise(noise):
    measured = rel_mse_of_difference(noise(0.1), noise(0.1))
    assert measured == pytest.approx(2 * 0.01, rel=0.1)


def test_bias_of_the_mean_and_its_interval(noise):
    pictures = [noise(0.5, mean=1.02) for _ in range(5)]
    parts = [float(noise(0.5).mean()) for _ in range(8)]
    bias = mean_bias(pictures, parts)
    assert abs(bias.value - 0.02) < bias.margin < 0.02


def test_interval_of_one_value_is_infinite():
    assert estimate([3.0]).value == 3 and np.isinf(estimate([3.0]).margin)
