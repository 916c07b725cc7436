"""Counted rays, where their number is known."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from envmap_integrator.system.ray_counts import Ray, count_rays
from tests.helpers import ball, camera, cluster, grey, integrator, load, picture, room

pytestmark = pytest.mark.usefixtures("variant")

WIDTH, HEIGHT, SPP = 16, 12, 4
PRIMARY = WIDTH * HEIGHT * SPP


@pytest.fixture(scope="module")
def hollow_ball(variant) -> mi.Scene:
    """A grey hollow ball with a point light in its middle: all of it is lit alike."""
    return load(
        {
            "type": "scene",
            "sensor": camera(WIDTH, HEIGHT, origin=(0, -0.5, 0), target=(0, 1, 0.1)),
            "walls": ball(0, 0, 0, 1) | {"flip_normals": True} | grey(0.5),
            "light": {"type": "point", "position": [0, 0, 0], "intensity": 1.0},
        }
    )


@pytest.fixture(scope="module")
def furnished(variant) -> mi.Scene:
    return load(room(sensor=camera(WIDTH, HEIGHT)))


def counted(scene: mi.Scene, kind: str, **settings) -> dict[str, int]:
    """The rays of a picture, without those of the preparation."""
    ours = integrator(kind, **settings)
    ours.prepare(scene)
    with count_rays() as counts:
        assert not counts
        picture(scene, ours, SPP)
    assert list(counts) == [kind.name.lower() for kind in Ray]
    return counts


@pytest.mark.parametrize("shadow_samples", [1, 4])
def test_source_selection(hollow_ball, shadow_samples):
    counts = counted(hollow_ball, "source_selection", shadow_samples=shadow_samples)
    assert counts["primary"] == PRIMARY
    # Where the cache doesn't serve a camera hit one more ray asks it, rarely with a shadow ray.
    assert counts["unbounded"] <= 0.02 * PRIMARY
    assert 0 <= counts["shadow"] - shadow_samples * PRIMARY <= counts["unbounded"]
    assert counts["secondary"] == counts["retraced"] == counts["source"] == counts["survey"] == 0


@pytest.mark.parametrize(("shadow_samples", "secondary_samples"), [(1, 1), (4, 1), (2, 3)])
def test_one_level_path(hollow_ball, shadow_samples, secondary_samples):
    counts = counted(
        hollow_ball,
        "one_level_path",
        shadow_samples=shadow_samples,
        secondary_samples=secondary_samples,
    )
    assert counts["primary"] == PRIMARY
    # A surface that the cache doesn't serve asks for a shadow ray and for one more ray.
    more = counts["unbounded"] - secondary_samples * PRIMARY
    assert 0 <= more <= 0.2 * secondary_samples * PRIMARY
    assert counts["shadow"] == shadow_samples * PRIMARY + more
    assert counts["secondary"] == counts["retraced"] == counts["source"] == counts["survey"] == 0


def test_cubes_bound_rays(furnished):
    counts = counted(furnished, "envmap_hybrid", desk=cluster(), secondary_samples=3)
    assert 0 < counts["retraced"] < counts["secondary"]
    assert counts["source"] == 0
    full = counted(furnished, "one_level_path", secondary_samples=3)
    assert full["secondary"] == 0
    assert counts["secondary"] + counts["unbounded"] == pytest.approx(full["unbounded"], rel=0.05)


def test_mirrors_that_read_the_map_look_for_sources():
    mirror = ball(0.4, 0.2, -1.6, 0.4) | {"bsdf": {"type": "roughconductor", "alpha": 0.01}}
    scene = load(room(sensor=camera(WIDTH, HEIGHT), ball=mirror))
    counts = counted(scene, "envmap_hybrid", desk=cluster(), mirrors="map")
    assert 0 < counts["source"] <= counts["secondary"]


def test_hidden_sources_are_passed(furnished):
    upwards = load(room(sensor=camera(WIDTH, HEIGHT, target=(0, 0, 2))))
    for kind in ("source_selection", "one_level_path"):
        assert counted(upwards, kind)["primary"] == PRIMARY
        assert PRIMARY < counted(upwards, kind, hide_emitters=True)["primary"] < 2 * PRIMARY


def test_preparation(furnished):
    """One gather ray of each sample of a patch; the bake comes on top."""
    counts = {}
    for kind in ("one_level_path", "envmap_hybrid"):
        with count_rays() as counts[kind]:
            integrator(kind).prepare(furnished)
    without, with_maps = counts.values()
    assert without["primary"] == without["secondary"] == 0
    assert without["survey"] > 0
    assert with_maps["primary"] > 0
    assert all(with_maps[kind] >= without[kind] for kind in without)


def test_counting_changes_no_picture(furnished):
    def render() -> np.ndarray:
        return picture(furnished, integrator("envmap_hybrid", desk=cluster()), SPP)

    before = render()
    with count_rays():
        during = render()
    np.testing.assert_array_equal(during, before)
    np.testing.assert_array_equal(render(), before)
