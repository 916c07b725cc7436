"""Spaces closed off from each other: which points are in which, and which patches remain."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from envmap_integrator.preparation.coarse_mesh.patch_points import only_standing
from envmap_integrator.preparation.coarse_mesh.spaces import find_spaces, separate
from tests.helpers import at, block, box, camera, grey
from tests.unit.kit import coarse_mesh, scene_of

pytestmark = pytest.mark.usefixtures("variant")

BUDGET = 1024
PAINT = {"type": "twosided"} | grey(0.5)
WALL = 0.1
"""Where a wall divides the room: at no border of a patch."""


def rooms(*places: float, gap: float = 0.0, contents=(), **others):
    """The mesh of a room 4 wide, a wall with a gap at one end in it, sensors at the given x, and
    others.
    """
    wall = at(WALL, 2 * gap, 0).rotate([0, 1, 0], 90).scale([2.1, 2.1, 1])
    shapes = [box(2.0), {"type": "rectangle", "to_world": wall}, *contents]
    sensors = {
        f"sensor{i}": camera(origin=(x, -1.8, 0.4), target=(x, 0.5, -1))
        for i, x in enumerate(places)
    }
    scene = scene_of(*(shape | {"bsdf": PAINT} for shape in shapes), **sensors, **others)
    return find_spaces(scene, only_standing(coarse_mesh(scene, BUDGET)))


def spaces_at(coarse, chosen) -> set[int]:
    """The spaces of the points on the floor that are chosen by their x."""
    x, y, z = coarse.points.position.T
    return set(coarse.space_of_point[chosen(x) & (abs(y) < 1.99) & (z < -1.99)].tolist())


def left(x):
    return x < WALL - 0.01


def right(x):
    return x > WALL + 0.01


# ---------------------- Points ----------------------


def test_rooms_that_sensors_are_in_are_spaces():
    coarse = rooms(-1, 1)
    here, there = (spaces_at(coarse, side) - {-1} for side in (left, right))
    assert len(here) == len(there) == 1 and here != there


@pytest.mark.parametrize("gap", [0.0, 0.3])
def test_a_wall_may_cut_through_the_film(gap):
    """Of a sensor with parallel rays; where both sides see each other, all is one space."""
    sensor = camera() | {"type": "orthographic"}
    parallel = {k: v for k, v in sensor.items() if k not in ("fov", "near_clip")}
    coarse = rooms(gap=gap, parallel=parallel)
    here, there = (spaces_at(coarse, side) - {-1} for side in (left, right))
    assert len(here) == len(there) == 1 and (here == there) == (gap > 0)


@pytest.mark.parametrize("places", [(-1.0, -1.2), (-1.0, 1.0)])
def test_sensors_that_see_the_same_share_a_space(places):
    assert rooms(*places, gap=0.3).space_of_point.max() == 0


def test_a_room_without_sensor_is_in_no_known_space():
    coarse = rooms(-1)
    assert spaces_at(coarse, right) == {-1}
    assert 0 in spaces_at(coarse, left)


def test_the_inside_of_a_closed_box_is_in_no_known_space():
    """However small it is."""
    coarse = rooms(-1, contents=[block(-1, 0, 0, 0.1)])
    offset = coarse.points.position - np.array([-1, 0, 0])
    on_box = abs(offset).max(axis=1) < 0.11
    inside = on_box & ((offset * coarse.points.normal).sum(axis=1) < 0)
    assert inside.any() and (coarse.space_of_point[inside] == -1).all()


def test_without_sensors_all_is_one_space():
    assert (rooms().space_of_point == 0).all()


# ---------------------- Patches ----------------------


def separated(coarse):
    one_cell = np.zeros(len(coarse.points), dtype=np.int64)
    return separate(coarse.scene, coarse.object_ids, replace(coarse, cell_of_point=one_cell))


def test_no_patch_is_looked_up_from_the_other_room():
    coarse = rooms(-1, 1)
    after, space = separated(coarse), coarse.space_of_point
    seen = (coarse.points.seen > 0) & (after.patch_of_point >= 0)
    space_of_patch = np.full(after.patches.count, -1)
    space_of_patch[after.patch_of_point[seen]] = space[seen]
    random = np.random.default_rng(1)
    for _ in range(8):
        patch, _, found = after.find(coarse.points, random.random((2, len(coarse.points))))
        known = found & (space >= 0) & (space_of_patch[patch] >= 0)
        assert known[seen].mean() > 0.8
        assert (space_of_patch[patch] == space)[known].all()


@pytest.mark.parametrize("places", [(-1,), (-1, 1)])
def test_in_a_single_space_patches_that_sensors_see_remain(places):
    """But for those of which a part may lie in another, as nothing on a walk sees it."""
    coarse = rooms(*places, gap=0.3)
    space, seen = coarse.space_of_point, coarse.points.seen > 0
    before, after = coarse.patch_of_point, separated(coarse).patch_of_point
    in_doubt = np.isin(before, before[(before >= 0) & (space < 0)])
    assert np.array_equal(after[seen & ~in_doubt], before[seen & ~in_doubt])
    assert (after[seen] >= 0).mean() > 0.95


def test_patches_that_no_sensor_comes_to_are_dropped():
    coarse = rooms(-1)
    patch_of_point = separated(coarse).patch_of_point
    outside = (coarse.points.position[:, 0] > WALL + 0.5).nonzero()
    assert (patch_of_point[outside] == -1).all()
