"""Filling and filtering of cube maps with masked texels."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from envmap_integrator.lookup.cube import solid_angles
from envmap_integrator.preparation.maps.mipmap import build_levels

RESOLUTION = 16
GARBAGE = 1e9


@pytest.fixture
def random():
    return np.random.default_rng(3)


def random_map(random, masked: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Values [6, R, R, 2] in [1, 2], garbage where the weight [6, R, R] is zero."""
    shape = (6, RESOLUTION, RESOLUTION)
    weight = random.uniform(0.1, 1, shape) * (random.uniform(size=shape) >= masked)
    value = random.uniform(1, 2, (*shape, 2))
    value[weight == 0] = GARBAGE
    return value, weight


def mean_over_sphere(level: np.ndarray) -> np.ndarray:
    weight = solid_angles(level.shape[1])[None, :, :, None]
    return (level * weight).sum(axis=(0, 1, 2)) / (4 * np.pi)


def test_levels_halve_down_to_one_texel_a_face(random):
    shapes = [level.shape for level in build_levels(*random_map(random))]
    assert shapes == [(6, size, size, 2) for size in (16, 8, 4, 2, 1)]


@pytest.mark.parametrize("masked", [0.0, 0.3, 0.99])
def test_a_constant_map_stays_constant(random, masked):
    value, weight = random_map(random, masked)
    value[weight > 0] = np.pi
    for level in build_levels(value, weight):
        assert_allclose(level, np.pi, rtol=1e-12)


def test_trusted_texels_are_kept_and_masked_ones_filled(random):
    value, weight = random_map(random, masked=0.5)
    before = value.copy()
    levels = build_levels(value, weight)
    assert np.array_equal(levels[0][weight > 0], before[weight > 0])
    for level in levels:
        assert level.min() >= 1 and level.max() <= 2


def test_the_mean_over_the_sphere_is_the_same_at_every_level(random):
    value, weight = random_map(random)
    expected = mean_over_sphere(value)
    for level in build_levels(value, np.ones_like(weight)):
        assert_allclose(mean_over_sphere(level), expected, rtol=1e-12)


def test_masked_texels_do_not_count_in_the_mean(random):
    value, weight = random_map(random, masked=0.5)
    trust = (weight * solid_angles(RESOLUTION))[..., None]
    expected = (value * trust).sum(axis=(1, 2)) / trust.sum(axis=(1, 2))
    assert_allclose(build_levels(value, weight)[-1][:, 0, 0], expected, rtol=1e-12)


def test_a_masked_face_takes_over_the_mean_of_the_others(random):
    value, weight = random_map(random)
    weight[2] = 0
    levels = build_levels(value, weight)
    trust = (weight * solid_angles(RESOLUTION))[..., None]
    expected = (value * trust).sum(axis=(0, 1, 2)) / trust.sum()
    for level in levels:
        assert_allclose(level[2], np.broadcast_to(expected, level[2].shape), rtol=1e-12)


def test_a_wholly_masked_map_is_black():
    value = np.zeros((6, 4, 4, 2))
    for level in build_levels(value, np.zeros((6, 4, 4))):
        assert not level.any()
