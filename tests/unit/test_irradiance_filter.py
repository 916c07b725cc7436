"""The filter of gathered irradiance on pictures made by hand, where the answer is known."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from envmap_integrator.jit import upload
from envmap_integrator.rendering.irradiance_filter import (
    RADIUS,
    Gathered,
    filter_irradiance,
    pixel_records,
    tolerance,
)

pytestmark = [
    pytest.mark.usefixtures("variant"),
    pytest.mark.variants("llvm_ad_rgb", "llvm_ad_mono"),
]

HEIGHT, WIDTH = 24, 32
ALLOWED = tolerance(64)
Y, X = np.mgrid[:HEIGHT, :WIDTH].astype(np.float64)


def filtered(
    irradiance, albedo=0.5, normal=(0, 0, 1), position=None, nearness=0.1, weight=1.0, spp=16
) -> np.ndarray:
    """The filtered radiance [H, W] of a picture of a plane that is one unit a pixel."""
    if position is None:
        position = np.stack([X, Y, np.zeros_like(X)], axis=-1) / 100

    def image(values, n=1):
        values = np.asarray(values, np.float64)
        values = values[..., None] if n == 1 else values
        sums = np.broadcast_to(values, (HEIGHT, WIDTH, n)) * np.asarray(weight)[..., None] * spp
        channels = [upload(mi.Float, sums[..., i]) for i in range(n)]
        return channels if n > 1 else channels[0]

    gathered = Gathered(
        radiance=mi.Spectrum(image(np.multiply(irradiance, albedo))),
        albedo=mi.Spectrum(image(albedo)),
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


def test_noise_falls_by_the_number_of_pixels_that_share():
    noise = np.random.default_rng(1).uniform(0, 2, (HEIGHT, WIDTH))
    inner = np.s_[RADIUS:-RADIUS, RADIUS:-RADIUS]
    result = filtered(noise, nearness=1e-6)[inner] / 0.5
    dy, dx = np.mgrid[-RADIUS : RADIUS + 1, -RADIUS : RADIUS + 1]
    taper = np.maximum(1 - (dx**2 + dy**2) / (RADIUS + 1) ** 2, 0)
    expected = (taper**2).sum() / taper.sum() ** 2
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
