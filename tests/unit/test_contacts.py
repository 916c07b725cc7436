"""Hits nearer than about the size of a patch aren't served by the coarse mesh."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from envmap_integrator.lookup.irradiance_cache import IrradianceCache
from envmap_integrator.transport.path import follow
from envmap_integrator.transport.rules import PathRules
from envmap_integrator.transport.state import PathStart
from tests.helpers import box, grey
from tests.unit.kit import coarse_mesh, scene_of, surface_points

pytestmark = pytest.mark.usefixtures("variant")

ALBEDO, WALL = 0.5, 2.0


def found(distance: float, primary: bool = False, n: int = 1 << 14) -> float:
    """Radiance along rays to the middle of a wall, of what has irradiance π everywhere.

    They come from a surface that is so many patches away, or from a sensor there.
    """
    scene = scene_of(box(WALL) | grey(ALBEDO), sky={"type": "constant"})
    coarse = coarse_mesh(scene, 512, points_per_patch=64)
    table = dr.full(mi.Float, dr.pi, 2 * coarse.patches.count * len(mi.Spectrum()))
    lookup = replace(coarse.lookup(), cache=IrradianceCache(coarse.patches, table))
    rules = PathRules(gather_depth=0 if primary else 1)
    (wall,) = coarse.object_ids.table.numpy()[coarse.object_ids.table.numpy() > 0]
    place = surface_points(np.array([[0.01, 0.02, -WALL]]), [0, 0, 1], wall)
    size = float(coarse.find(place)[1][0])

    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, n)
    origin = dr.zeros(mi.Interaction3f, n)
    origin.p = mi.Point3f(0.01, 0.02, -WALL + distance * size)
    start = PathStart(
        ray=mi.Ray3f(origin.p, mi.Vector3f(0, 0, -1)),
        depth=mi.UInt32(0 if primary else 1),
        origin=origin,
        emitter_row=mi.UInt32(0),
        pdf=mi.Float(dr.inv_pi),
        specular=mi.Bool(primary),
        primary=primary,
    )
    end = follow(scene, lookup, rules, sampler, start, dr.full(mi.Bool, True, n))
    return float(end.radiance.numpy().mean())


@pytest.mark.parametrize(("distance", "served"), [(0.2, 0.0), (1.0, 0.5), (3.0, 1.0)])
def test_hits_at_contacts_are_not_served(distance, served):
    """At one patch's size it's one in two, at random: no border shows."""
    expected = served * ALBEDO + (1 - served) * ALBEDO**2
    assert found(distance) == pytest.approx(expected, rel=0.05)


def test_a_sensor_is_no_surface():
    assert found(0.2, primary=True) == pytest.approx(ALBEDO, rel=0.05)
