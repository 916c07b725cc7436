"""``clamp_indirect`` cuts what secondary rays bring, and nothing else."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from tests.helpers import ball, camera, lamp, room

pytestmark = pytest.mark.usefixtures("variant")

CLAMP = 0.2


@pytest.fixture(scope="module")
def caustic(variant) -> mi.Scene:
    """A room with a glass ball under the lamp, whose caustic secondary rays find by chance."""
    glass = ball(0.4, 0.2, -1.5, 0.4) | {"bsdf": {"type": "dielectric"}}
    parts = {"ball": glass, "lamp": lamp(0.4, 0.2, 1.9, 0.1, 300.0), "sensor": camera(256, 192)}
    return mi.load_dict(room(**parts))


@pytest.mark.parametrize("kind", ["envmap_hybrid", "one_level_path"])
def test_no_secondary_ray_brings_more(caustic, kind):
    def picture(**settings):
        integrator = mi.load_dict({"type": kind, "irradiance_filter": False} | settings)
        return np.array(mi.render(caustic, integrator=integrator, spp=1, seed=3))

    whole, cut, direct = (picture(clamp_indirect=c) for c in (0.0, CLAMP, 1e-12))
    assert np.array_equal(whole, picture(clamp_indirect=1e30))
    indirect, cut_indirect = whole - direct, cut - direct
    assert indirect.max() > 2 * CLAMP
    assert (cut_indirect <= CLAMP + 1e-5).all()
    assert (cut_indirect <= indirect + 1e-5).all()
    # Most pixels have none so bright.
    assert np.isclose(cut, whole, rtol=1e-5).mean() > 0.5


@pytest.mark.parametrize("value", [-1.0, float("inf")])
def test_it_is_a_radiance(value):
    with pytest.raises(Exception, match='"clamp_indirect" must be at least 0'):
        mi.load_dict({"type": "one_level_path", "clamp_indirect": value})
