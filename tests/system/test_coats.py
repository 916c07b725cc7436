"""Rooms all of varnish: the cache knows from where their light comes in."""

from __future__ import annotations

import pytest

from tests.helpers import assert_agree, ball, block, box, integrator, load, measure, room

pytestmark = pytest.mark.usefixtures("variant")

#: Materials, and the relative error that is left. If all directions counted alike, it would be
#: -2.3 % and +1.6 %.
COATS = {
    "plastic": ({"type": "plastic", "diffuse_reflectance": 0.7}, 0.004),
    "principled": ({"type": "principled", "roughness": 0.8, "specular": 0.5}, 0.006),
}


@pytest.mark.parametrize("name", COATS)
def test_rooms_of_varnish_are_as_bright_as_by_path(name):
    bsdf, allowed = COATS[name]
    if name == "principled":
        bsdf = bsdf | {"base_color": {"type": "rgb", "value": 0.7}}
    parts = (box(2.0), block(-0.5, 0.6, -1.5, 0.4), ball(0.4, 0.2, -1.6, 0.4))
    names = ("walls", "block", "ball")
    described = room(**{n: part | {"bsdf": bsdf} for n, part in zip(names, parts, strict=True)})
    ours = integrator("one_level_path", patches=8192, patch_samples=256, sampler="coherent")
    expected = measure(load(described), integrator("path", max_depth=-1), spp=512, seeds=8)
    found = measure(load(described), ours, spp=128)
    assert_agree(found.overall(), expected.overall(), allowed, precision=0.004)
