"""Sample points are stratified in every pixel, alike in neighbouring ones, and uniform."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy import stats

from envmap_integrator.imaging.sample_points import SamplePoints, shared_strata
from envmap_integrator.system.jit import LANES_ALIKE

pytestmark = pytest.mark.usefixtures("variant")

DIMENSIONS = 3
#: Of all tests together, to fail by chance.
SIGNIFICANCE = 1e-6


def points_of(lane: mi.UInt32, count: int, first: mi.UInt32, seed: int = 0) -> SamplePoints:
    return SamplePoints.of(mi.UInt32(seed % 2**32), lane, mi.UInt32(shared_strata(count)), first)


def draw(count: int, lanes: int, seed: int = 0, pairs: bool = True) -> np.ndarray:
    """All samples of some lanes, [dimension, sample, lane, 2 or 1]."""
    lane = dr.arange(mi.UInt32, lanes * count)
    points = points_of(lane % lanes, count, lane // lanes, seed)
    found = []
    for _ in range(DIMENSIONS):
        drawn = points.next_2d() if pairs else mi.Vector1f(points.next_1d())
        found.append(np.array(drawn).reshape(-1, count, lanes).transpose(1, 2, 0))
    return np.stack(found)


@pytest.mark.parametrize("count", [1, 4, 16, 64, 256])
def test_pairs_are_stratified_in_all_elementary_intervals(count):
    points = draw(count, lanes=20)
    levels = count.bit_length() - 1
    for level in range(levels + 1):
        columns, rows = 2**level, 2 ** (levels - level)
        cell = np.floor(points[..., 0] * columns) * rows + np.floor(points[..., 1] * rows)
        assert (np.sort(cell, axis=1) == np.arange(count)[:, None]).all()


@pytest.mark.parametrize("count", [1, 8, 64])
def test_numbers_are_stratified(count):
    cell = np.floor(draw(count, lanes=20, pairs=False)[..., 0] * count)
    assert (np.sort(cell, axis=1) == np.arange(count)[:, None]).all()


def test_neighbours_share_strata_and_no_more():
    points = draw(64, lanes=2 * LANES_ALIKE)
    strata = np.floor(points * 8)
    first = strata[:, :, :1]
    alike, others = strata[:, :, :LANES_ALIKE], strata[:, :, LANES_ALIKE:]
    assert (alike[1:] == first[1:]).all()
    # Of two numbers that have nothing to do with each other, one in 8 is in the same stratum.
    assert (others == first).mean() == pytest.approx(1 / 8, abs=0.03)
    # The place in the pixel has no part in it.
    assert (alike[0, :, 1:] == first[0]).mean() == pytest.approx(1 / 8, abs=0.03)
    within = points * 8 - strata
    assert len(np.unique(within[0, 0, :LANES_ALIKE, 0])) == LANES_ALIKE


def test_strata_are_shared_that_all_pixels_fill_equally():
    points = draw(48, lanes=LANES_ALIKE)[1:]
    strata = np.floor(points * 4)
    assert (strata == strata[:, :, :1]).all()
    cell = np.sort(4 * strata[..., 0] + strata[..., 1], axis=1)
    assert (cell == np.repeat(np.arange(16), 3)[:, None]).all()


@pytest.mark.parametrize("count", [1, 37, 64])
def test_every_sample_is_uniform(count):
    """Of many groups of lanes: whatever a sample's index, so that any number may be taken."""
    points = draw(count, lanes=LANES_ALIKE * 4096)[:, :, ::LANES_ALIKE]
    for sample in (0, count // 2, count - 1):
        for dimension in range(DIMENSIONS):
            x, y = (points[dimension, sample] * 16).astype(int).T
            observed = np.bincount(16 * x + y, minlength=256)
            assert stats.chisquare(observed).pvalue > SIGNIFICANCE


def test_dimensions_and_samples_are_independent():
    points = draw(4, lanes=LANES_ALIKE * 4096)[:, :, ::LANES_ALIKE]
    numbers = points[:, 0].transpose(0, 2, 1).reshape(2 * DIMENSIONS, -1)
    correlation = np.corrcoef(numbers) - np.eye(2 * DIMENSIONS)
    assert np.abs(correlation).max() < 5 / np.sqrt(numbers.shape[1])


@pytest.mark.parametrize("count", [1, 12, 16, 37])
def test_errors_of_neighbours_are_independent(count):
    """Else to share light between pixels would take no noise away."""
    points = draw(count, lanes=LANES_ALIKE * 2048)[1]
    value = np.exp(points[..., 0] + points[..., 1] ** 2) * (points[..., 0] > 0.3)
    mean = value.mean(axis=0).reshape(-1, LANES_ALIKE)
    alone, together = mean.var(), mean.mean(axis=1).var()
    # Of a variance estimated from n values, the standard error is about sqrt(2 / n).
    assert together == pytest.approx(alone / LANES_ALIKE, rel=4 * np.sqrt(2 / len(mean)))


def test_errors_of_neighbours_are_independent_for_edges_in_a_pixel():
    """What is seen at one place of it sends other light than what is seen at the next."""
    place, direction = draw(16, lanes=LANES_ALIKE * 2048)[:2]
    value = (place[..., 0] > 0.6) * (direction.sum(axis=-1) > 1.2)
    mean = value.mean(axis=0).reshape(-1, LANES_ALIKE)
    alone, together = mean.var(), mean.mean(axis=1).var()
    assert together == pytest.approx(alone / LANES_ALIKE, rel=4 * np.sqrt(2 / len(mean)))


def test_stratified_points_have_less_error():
    def variance(count):
        points = draw(count, lanes=LANES_ALIKE * 256)[0]
        return np.exp(points.sum(axis=-1)).mean(axis=0).var()

    # Independent points: 16 times less variance for 16 times as many.
    assert variance(64) < variance(4) / 100


def test_seeds_give_other_points():
    points = [draw(4, lanes=64, seed=seed) for seed in (0, 1, 2**32 - 1)]
    assert not any(np.isin(points[0], other).mean() > 0.01 for other in points[1:])
    np.testing.assert_array_equal(points[0], draw(4, lanes=64, seed=2**32))


def test_points_of_another_sample():
    """One after the other, points are those of a later start."""
    lane = dr.arange(mi.UInt32, 32)
    points = points_of(lane, 8, mi.UInt32(2))
    points.next_1d()
    points.next_2d()
    points = points.of_sample(mi.UInt32(3))
    later = points_of(lane, 8, mi.UInt32(3))
    np.testing.assert_array_equal(points.next_2d().numpy(), later.next_2d().numpy())
