"""The filter of gathered irradiance on pictures made by hand, where the answer is known."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from envmap_integrator.imaging.irradiance_filter import (
    RADIUS,
    filter_irradiance,
    pixel_records,
    tolerance,
)
from envmap_integrator.system.jit import upload
from envmap_integrator.transport.gathered import Gathered

pytestmark = [
    pytest.mark.usefixtures("variant"),
    pytest.mark.variants("llvm_ad_rgb", "llvm_ad_mono"),
]

HEIGHT, WIDTH = 90, 100
ALLOWED = tolerance(64)
Y, X = np.mgrid[:HEIGHT, :WIDTH].astype(np.float64)


def filtered(
    irradiance, albedo=0.5, normal=(0, 0, 1), position=None, nearness=0.1, weight=1.0, spp=16
) -> np.ndarray:
    """The filtered radiance [H, W] of a picture of a plane that is one unit a pixel.

    It's that of the first colour, if ``irradiance`` and ``albedo`` are [H, W, 3].
    """
    if position is None:
        position = np.stack([X, Y, np.zeros_like(X)], axis=-1) / 100

    def image(values, n=1):
        values = np.asarray(values, np.float64)
        values = values[..., None] if n == 1 else values
        sums = np.broadcast_to(values, (HEIGHT, WIDTH, n)) * np.asarray(weight)[..., None] * spp
        channels = [upload(mi.Float, sums[..., i]) for i in range(n)]
        return channels if n > 1 else channels[0]

    def spectrum(values):
        if np.ndim(values) < 3:
            return mi.Spectrum(image(values))
        return mi.Spectrum(*image(values, 3)[: len(mi.Spectrum())])

    gathered = Gathered(
        radiance=spectrum(np.multiply(irradiance, albedo)),
        albedo=spectrum(albedo),
        normal=mi.Vector3f(image(normal, 3)),
        position=mi.Vector3f(image(position, 3)),
        nearness=image(nearness),
        weight=image(np.ones((HEIGHT, WIDTH))),
    )
    result = filter_irradiance(pixel_records(gathered), WIDTH, ALLOWED)
    assert dr.width(result) == HEIGHT * WIDTH
    return result[0].numpy().reshape(HEIGHT, WIDTH) / spp


def test_textures_stay_as_they_are():
    """Where the irradiance is the same everywhere, also at the borders and under black."""
    albedo = np.random.default_rng(0).uniform(0, 1, (HEIGHT, WIDTH))
    albedo[4:8] = 0
    np.testing.assert_allclose(filtered(3.0, albedo), 3 * albedo, rtol=1e-5)


def variance_of_equal_sharing() -> float:
    """Of a pixel, over that of one that shares nothing, where all pixels may share."""
    dy, dx = np.mgrid[-RADIUS : RADIUS + 1, -RADIUS : RADIUS + 1]
    taper = np.maximum(1 - (dx**2 + dy**2) / (RADIUS + 1) ** 2, 0)
    return (taper**2).sum() / taper.sum() ** 2


@pytest.mark.parametrize("distribution", ["uniform", "exponential"])
def test_noise_falls_by_the_number_of_pixels_that_share(distribution):
    noise = getattr(np.random.default_rng(1), distribution)(size=(HEIGHT, WIDTH))
    inner = np.s_[RADIUS:-RADIUS, RADIUS:-RADIUS]
    result = filtered(noise, nearness=1e-6)[inner] / 0.5
    expected = variance_of_equal_sharing()
    assert expected < 1 / 25
    assert result.var() / noise.var() == pytest.approx(expected, rel=0.3)


def test_nothing_is_shared_around_a_corner():
    normal = np.where(X[..., None] < 16, (0, 0, 1), (-1, 0, 0))
    step = np.where(X < 16, 1.0, 5.0)
    np.testing.assert_allclose(filtered(step, normal=normal), step / 2, rtol=1e-4)


def test_nothing_is_shared_with_what_lies_behind():
    """By as much as what it sees is far away."""
    position = np.stack([X / 100, Y / 100, np.where(X < 16, 0.0, 10.0)], axis=-1)
    step = np.where(X < 16, 1.0, 5.0)
    np.testing.assert_allclose(filtered(step, position=position), step / 2, rtol=1e-4)


def test_nothing_is_shared_close_to_contacts():
    noise = np.random.default_rng(2).uniform(0, 2, (HEIGHT, WIDTH))
    np.testing.assert_allclose(filtered(noise, nearness=1e4), noise / 2, rtol=1e-4)


def test_gradients_stay():
    ramp = 1 + X / WIDTH
    inner = np.s_[RADIUS:-RADIUS, RADIUS:-RADIUS]
    np.testing.assert_allclose(filtered(ramp)[inner], ramp[inner] / 2, rtol=1e-4)


EDGE = 16
CORNER = np.where(X[..., None] < EDGE, (0, 0, 1), (-1, 0, 0))


def test_gradients_stay_where_a_surface_ends():
    """Beside a corner and at the picture's border, where a mean is 14 % off."""
    ramp = 1 + np.abs(X + 0.5 - EDGE) / 10
    result = filtered(ramp, normal=CORNER, nearness=1e-6) / 0.5
    np.testing.assert_allclose(result, ramp, rtol=0.015)


def test_chance_is_no_gradient():
    """Where a surface ends, noise falls nearly as by a mean of those that are on one side."""
    noise = np.random.default_rng(5).exponential(size=(HEIGHT, WIDTH))
    edge = filtered(noise, normal=CORNER, nearness=1e-6)[RADIUS:-RADIUS, [EDGE - 1, EDGE]] / 0.5
    dy, dx = np.mgrid[-RADIUS : RADIUS + 1, : RADIUS + 1]
    taper = np.maximum(1 - (dx**2 + dy**2) / (RADIUS + 1) ** 2, 0)
    assert edge.var() < 2 * (taper**2).sum() / taper.sum() ** 2
    assert edge.mean() == pytest.approx(1, abs=0.05)


def test_colours_of_textures_are_no_gradient():
    """Under coloured light they are unequally bright, but irradiance is the same."""
    albedo = np.random.default_rng(6).uniform(0, 1, (HEIGHT, WIDTH, 3))
    albedo[: HEIGHT // 2] *= (1, 0.3, 0.1)
    result = filtered(np.array([1.0, 3.0, 9.0]), albedo, nearness=1e-6)
    np.testing.assert_allclose(result, albedo[..., 0], rtol=1e-4)


def test_pixels_without_a_surface_give_and_get_nothing():
    weight = np.where((X + Y) % 3 == 0, 0.0, 1.0)
    result = filtered(np.where(weight > 0, 2.0, 100.0), weight=weight)
    np.testing.assert_allclose(result, weight, rtol=1e-5)


def test_what_is_not_finite_stays_where_it_is():
    irradiance = np.ones((HEIGHT, WIDTH))
    irradiance[10, 10] = np.inf
    result = filtered(irradiance)
    assert np.isfinite(np.delete(result, 10 * WIDTH + 10)).all()


def test_less_is_allowed_for_as_samples_grow():
    allowed = np.array([tolerance(n) for n in (1, 16, 64, 4096, 1 << 24)])
    assert (np.diff(allowed) < 0).all() and allowed[-1] < 0.05


# ---------------------- Outliers ----------------------

CENTRE = (HEIGHT // 2, WIDTH // 2)


@pytest.mark.parametrize("brightness", [10, 100, 1e4, 1e8])
def test_an_outlier_is_not_seen_around_it(brightness):
    """Without a limit its neighbours would get a fortieth of it; none of its light is lost."""
    irradiance = np.ones((HEIGHT, WIDTH))
    irradiance[CENTRE] = brightness
    result = filtered(irradiance, nearness=1e-6) / 0.5
    assert np.delete(result, np.ravel_multi_index(CENTRE, result.shape)).max() < 1.4
    assert result.sum() == pytest.approx(irradiance.sum(), rel=1e-4)


def test_some_outliers_do_not_justify_each_other():
    irradiance = np.ones((HEIGHT, WIDTH))
    outliers = [(40, 50), (42, 50), (41, 53)]
    for place in outliers:
        irradiance[place] = 100
    result = filtered(irradiance, nearness=1e-6) / 0.5
    assert result.max() < 2
    assert result.sum() == pytest.approx(irradiance.sum(), rel=1e-4)


def test_an_outlier_is_not_seen_around_a_corner():
    normal = np.where(X[..., None] < 52, (0, 0, 1), (-1, 0, 0))
    irradiance = np.ones((HEIGHT, WIDTH))
    irradiance[CENTRE] = 100
    result = filtered(irradiance, normal=normal, nearness=1e-6) / 0.5
    np.testing.assert_allclose(result[:, 52:], 1, rtol=1e-4)


def test_what_many_have_found_is_shared():
    """A bright line one pixel wide: as many as it has in reach share its noise."""
    noise = 100 * np.random.default_rng(3).uniform(0.5, 1.5, HEIGHT)
    irradiance = np.ones((HEIGHT, WIDTH))
    irradiance[:, CENTRE[1]] = noise
    result = filtered(irradiance, nearness=1e-6)[RADIUS:-RADIUS] / 0.5
    taper = 1 - np.arange(-RADIUS, RADIUS + 1) ** 2 / (RADIUS + 1) ** 2
    expected = np.convolve(noise, taper / taper.sum(), "valid")
    beside, on = result[:, CENTRE[1] + 1], result[:, CENTRE[1]]
    assert np.corrcoef(on, expected)[0, 1] > 0.99
    assert beside.mean() > 0.9 * on.mean() > 10


def test_light_that_few_find_is_shared():
    """Where three in a hundred samples meet it, four a pixel: most neighbours are black."""
    found = np.random.default_rng(4).binomial(4, 0.03, (HEIGHT, WIDTH))
    inner = np.s_[RADIUS:-RADIUS, RADIUS:-RADIUS]
    result = filtered(found, nearness=1e-6)[inner] / 0.5
    assert result.var() / found.var() < 1.6 * variance_of_equal_sharing()
    assert result.mean() == pytest.approx(found.mean(), rel=0.03)
