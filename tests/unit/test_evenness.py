"""Patches across sharp edges of light are told from those with noise or gradients."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from envmap_integrator.radiosity.direct_light import SAMPLES
from envmap_integrator.radiosity.evenness import uneven

pytestmark = pytest.mark.usefixtures("variant")

N_PATCHES = 64


def is_uneven(light, scale: float = 1.0) -> np.ndarray:
    """Which of some patches [K] are, lit by ``light(x, rng)`` at places ``x`` [K, N, 3] in them."""
    rng = np.random.default_rng(0)
    x = rng.uniform(-1, 1, (N_PATCHES, SAMPLES, 3))
    irradiance = np.broadcast_to(light(x, rng), x.shape[:2])
    flat = (scale * x).reshape(-1, 3).T
    return uneven(
        mi.Float(irradiance.ravel().astype(np.float32)), mi.Point3f(flat.astype(np.float32))
    ).numpy()


@pytest.mark.parametrize("scale", [1e-4, 1.0, 1e5])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_an_edge_is_found_along_every_axis(axis, scale):
    assert is_uneven(lambda x, rng: np.where(x[..., axis] > 0.3, 5.0, 0.0), scale).all()


@pytest.mark.parametrize(
    "light",
    [
        lambda x, rng: 0.0,
        lambda x, rng: 1e8,
        lambda x, rng: 1e-8,
        lambda x, rng: 1 + 0.3 * x[..., 0],
        lambda x, rng: rng.exponential(size=x.shape[:2]),
        lambda x, rng: 1e6 + rng.uniform(-1, 1, x.shape[:2]),
    ],
    ids=["dark", "bright", "dim", "gradient", "noise", "nearly constant"],
)
def test_what_is_lit_evenly_stays(light):
    assert not is_uneven(light).any()


def test_a_single_bright_sample_is_no_edge():
    def firefly(x, rng):
        light = np.ones(x.shape[:2])
        light[:, 17] = 1e4
        return light

    assert not is_uneven(firefly).any()


def test_flat_patches_are_compared_along_the_axes_that_they_have():
    def edge(x, rng):
        x[..., 2] = 0.5
        return np.where(x[..., 1] > 0, 1.0, 0.0)

    assert is_uneven(edge).all()
