"""Samples of a pixel stand for its reconstruction filter."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
from scipy import integrate
from scipy.stats import qmc

from envmap_integrator.imaging.pixel_filter import PixelFilter
from envmap_integrator.system.jit import upload

pytestmark = pytest.mark.usefixtures("variant")

FILTERS = {
    "box": {},
    "tent": {},
    "gaussian": {"stddev": 0.5},
    "mitchell": {},
    "catmullrom": {},
    "lanczos": {},
}


@pytest.fixture(params=FILTERS)
def rfilter(request, variant):
    return mi.load_dict({"type": request.param} | FILTERS[request.param])


def sampled(rfilter) -> tuple[np.ndarray, np.ndarray]:
    """Offsets [2, N] and weights [N] of well spread numbers."""
    u = qmc.Sobol(2, seed=0).random_base2(18)
    offset, weight = PixelFilter.of(rfilter).sample(mi.Point2f(*(upload(mi.Float, a) for a in u.T)))
    return offset.numpy(), np.broadcast_to(weight.numpy(), len(u))


def moment(rfilter, function) -> float:
    """Mean of a function [pixels] as the filter weights it."""
    x = np.linspace(-rfilter.radius(), rfilter.radius(), 1 << 14)
    value = rfilter.eval(upload(mi.Float, x)).numpy()
    return integrate.trapezoid(value * function(x), x) / integrate.trapezoid(value, x)


def test_weights(rfilter):
    offset, weight = sampled(rfilter)
    assert weight.mean() == pytest.approx(1, abs=1e-3)
    negative = rfilter.eval(upload(mi.Float, offset.ravel())).numpy().reshape(2, -1) < 0
    np.testing.assert_array_equal(weight < 0, negative[0] != negative[1])
    assert len(np.unique(np.abs(weight))) == 1
    assert np.abs(offset).max() <= rfilter.radius()


@pytest.mark.parametrize("function", [np.square, np.cos, np.abs], ids=lambda f: f.__name__)
def test_moments(rfilter, function):
    offset, weight = sampled(rfilter)
    for axis in range(2):
        mean = np.mean(weight * function(offset[axis]))
        assert mean == pytest.approx(moment(rfilter, function), abs=1e-3)
