"""Patches across sharp edges of light are told from those with noise or gradients."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from envmap_integrator.preparation.radiosity.direct_light import SAMPLES
from envmap_integrator.preparation.radiosity.evenness import contrasts

pytestmark = pytest.mark.usefixtures("variant")

N_PATCHES = 64


def found(light, scale: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Which of some patches [K] have an edge of light and which are lit unevenly.

    They are lit by ``light(x, rng)`` at places ``x`` [K, N, 3] in them.
    """
    rng = np.random.default_rng(0)
    x = rng.uniform(-1, 1, (N_PATCHES, SAMPLES, 3))
    irradiance = np.broadcast_to(light(x, rng), x.shape[:2])
    flat = (scale * x).reshape(-1, 3).T
    edge, uneven = contrasts(
        mi.Float(irradiance.ravel().astype(np.float32)), mi.Point3f(flat.astype(np.float32))
    )
    edge, uneven = edge.numpy(), uneven.numpy()
    assert uneven[edge].all()
    return edge, uneven


@pytest.mark.parametrize("scale", [1e-4, 1.0, 1e5])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_an_edge_is_found_along_every_axis(axis, scale):
    assert found(lambda x, rng: np.where(x[..., axis] > 0.3, 5.0, 0.0), scale)[0].all()


@pytest.mark.parametrize(
    "light",
    [
        lambda x, rng: 0.0,
        lambda x, rng: 1e8,
        lambda x, rng: 1e-8,
        lambda x, rng: 1 + 0.1 * x[..., 0],
        lambda x, rng: rng.exponential(size=x.shape[:2]),
        lambda x, rng: 1e6 + rng.uniform(-1, 1, x.shape[:2]),
    ],
    ids=["dark", "bright", "dim", "slight gradient", "noise", "nearly constant"],
)
def test_what_is_lit_evenly_stays(light):
    edge, uneven = found(light)
    assert not edge.any() and not uneven.any()


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_what_changes_within_a_patch_is_no_edge(axis):
    edge, uneven = found(lambda x, rng: 1 + 0.4 * x[..., axis])
    assert uneven.all() and not edge.any()


def test_a_single_bright_sample_is_no_edge():
    def firefly(x, rng):
        light = np.ones(x.shape[:2])
        light[:, 17] = 1e4
        return light

    assert not found(firefly)[1].any()


def test_flat_patches_are_compared_along_the_axes_that_they_have():
    def edge(x, rng):
        x[..., 2] = 0.5
        return np.where(x[..., 1] > 0, 1.0, 0.0)

    assert found(edge)[0].all()
