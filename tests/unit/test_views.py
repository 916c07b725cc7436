"""Which views a state serves."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from envmap_integrator.preparation.coarse_mesh.surface_points import in_steps
from envmap_integrator.preparation.radiosity.noise import TARGET
from envmap_integrator.preparation.views import (
    NO_VIEW,
    Service,
    service,
    usual_service,
    view_name,
    walks,
)
from tests.helpers import box, camera, emitting, grey, load, room
from tests.unit.kit import CoarseMesh, coarse_mesh, scene_of

pytestmark = pytest.mark.usefixtures("variant")


def served(coarse: CoarseMesh, sensor: mi.Sensor) -> Service:
    points = walks(coarse.scene, coarse.object_ids, sensor)
    return service(points, coarse.solve(16), 0.0)


def test_a_view_is_named_by_where_it_looks():
    here, again, there = (mi.load_dict(camera(origin=(x, -1.8, 0.4))) for x in (0.0, 0.0, 0.1))
    assert view_name(here) == view_name(again) != view_name(there)
    parameters = mi.traverse(again)
    parameters["x_fov"] = 30.0
    parameters.update()
    assert view_name(here) != view_name(again)


def test_a_sensor_may_see_but_one_place():
    """The sphere around what its walks have found has some width then."""
    assert 0 < in_steps(0.0) < in_steps(1e-9)


def test_a_view_of_the_same_room_is_served():
    coarse = coarse_mesh(load(room()), 1024, points_per_patch=32)
    usual = usual_service(coarse, 0.01)
    assert usual.found > 0.9 and usual.patches > 100
    for origin in ((0.5, -1.7, 0.6), (-1.5, 1.5, 1.0)):
        other = mi.load_dict(camera(origin=origin))
        found = served(coarse, other)
        assert found.suffices(usual)


def test_a_view_of_another_room_is_not():
    far = box(2.0) | {"to_world": mi.ScalarTransform4f().translate([10, 0, 0]).scale(2)} | grey(0.5)
    coarse = coarse_mesh(load(room(other=far)), 1024, points_per_patch=32)
    usual = usual_service(coarse, 0.01)
    other = mi.load_dict(camera(origin=(10, -1.8, 0.4), target=(10, 0.5, -1)))
    found = served(coarse, other)
    assert found.found < 0.1
    assert not found.suffices(usual)


@pytest.mark.parametrize(
    ("found", "patches", "error", "suffices"),
    [
        (0.95, 500, 0.01, True),
        (0.95, 200, 0.01, False),
        (0.90, 1000, 0.01, False),
        (0.96, 1000, 0.014, True),
        (0.96, 1000, 0.016, False),
    ],
)
def test_it_must_serve_a_view_about_as_well(found, patches, error, suffices):
    assert Service(found, patches, error).suffices(Service(0.96, 1000, 0.01)) == suffices


def test_small_errors_are_all_small_enough():
    assert Service(1.0, 1000, TARGET).suffices(Service(1.0, 1000, 0.0))


def test_a_mesh_made_for_no_view_serves_none():
    coarse = coarse_mesh(scene_of(box(2.0) | grey(0.5), box(0.1) | emitting(1)), 256)
    usual = usual_service(coarse, 0.01)
    assert usual == Service(1.0, NO_VIEW, 0.01)
    sensor = mi.load_dict(camera())
    assert not served(coarse, sensor).suffices(usual)


def test_a_view_that_asks_for_nothing_is_served():
    coarse = coarse_mesh(load(room()), 256)
    away = mi.load_dict(camera(origin=(0, -30, 0), target=(0, -60, 0)))
    found = served(coarse, away)
    assert found.suffices(usual_service(coarse, 0.01))
    assert np.isinf(found.patches) and found.error == 0
