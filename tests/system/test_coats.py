"""Varnish: the cache knows from where its light comes in, and what is gloss."""

from __future__ import annotations

import mitsuba as mi
import pytest

from tests.helpers import (
    assert_agree,
    at,
    ball,
    block,
    box,
    camera,
    grey,
    integrator,
    lamp,
    load,
    measure,
    room,
    scaled,
)

pytestmark = pytest.mark.usefixtures("variant")

#: Materials, and the relative error that is left. If all directions counted alike, it would be
#: -2.3 % and +1.6 %; if half of the metal's gloss were taken for diffuse, -1 %.
COATS = {
    "plastic": ({"type": "plastic", "diffuse_reflectance": 0.7}, 0.004),
    "principled": ({"type": "principled", "roughness": 0.8, "specular": 0.5}, 0.004),
    "blend": (
        {
            "type": "blendbsdf",
            "weight": 0.3,
            "diffuse": {
                "type": "diffuse",
                "reflectance": {"type": "rgb", "value": [0.6, 0.5, 0.4]},
            },
            "metal": {"type": "roughconductor", "alpha": 0.2},
        },
        0.002,
    ),
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


def test_what_shines_on_varnish_at_grazing_angles_goes_on():
    """Light from under a partition is reflected by the floor, away from it.

    If all that the floor samples with less than 1/sr came back alike, the partition would be 3 %
    brighter.
    """
    floor = {"type": "rectangle", "to_world": at(0, 0, -1.99) @ scaled(2)}
    partition = {
        "type": "cube",
        "to_world": at(0, 0, 0.5) @ mi.ScalarTransform4f().scale([2, 0.05, 1.5]),
    }
    described = room(
        walls=box(2.0) | grey(0.1),
        lamp=lamp(0, 1.5, 1.9, half_width=0.3, power=40),
        floor=floor | {"bsdf": {"type": "roughplastic", "alpha": 0.2, "diffuse_reflectance": 0.3}},
        partition=partition | grey(0.5),
        sensor=camera(16, 12, origin=(0, -1.9, 0.5), target=(0, 0, 0.7)),
        block=None,
        ball=None,
    )
    ours = integrator("one_level_path", patches=8192, patch_samples=256, sampler="coherent")
    expected = measure(load(described), integrator("path", max_depth=-1), spp=4096, seeds=8)
    found = measure(load(described), ours, spp=1024)
    assert_agree(found.overall(), expected.overall(), allowed=0.01, precision=0.02)
