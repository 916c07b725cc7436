"""The coarse mesh: bounded in number, found from any surface point, smooth when jittered."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
from numpy.testing import assert_allclose

from envmap_integrator.preparation.coarse_mesh.surface_points import scatter_points
from envmap_integrator.preparation.pipeline import POINTS_PER_PATCH
from tests.helpers import at, ball, block, box, load, room, scaled
from tests.unit.kit import (
    WALL,
    CoarseMesh,
    coarse_mesh,
    coarse_mesh_over,
    mesh,
    scene_of,
    surface_points,
)

pytestmark = pytest.mark.usefixtures("variant")

BUDGET = 1024
#: Share of points that may be lost to full buckets of the hash tables.
FULL_BUCKETS = 1e-3


def wavy_sheet(n: int = 230) -> mi.Mesh:
    """A sheet of more than 100,000 triangles."""
    y, x = np.mgrid[0 : n + 1, 0 : n + 1] / n * 2 - 1
    vertices = np.stack([x, y, 0.1 * np.sin(9 * x) * np.cos(7 * y)], axis=-1).reshape(-1, 3)
    corner = (np.arange(n)[:, None] * (n + 1) + np.arange(n)).ravel()
    a, b, c, d = corner, corner + 1, corner + n + 2, corner + n + 1
    return mesh(vertices, np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]))


def swarm(count: int = 300) -> list[dict]:
    """Small spheres in a cube."""
    centres = np.random.default_rng(4).uniform(-1, 1, (count, 3))
    return [ball(*map(float, centre), 0.03) for centre in centres]


def one_of_each(scale: float = 1.0, shift: float = 0.0) -> mi.Scene:
    """Every kind of shape, in a closed box; the instances are two spheres."""
    group = {"type": "shapegroup", "part": ball(0, 0, 0, 0.3 * scale)}
    instance = {"type": "instance", "group": {"type": "ref", "id": "group"}}
    # Mitsuba itself is imprecise where an instance's transform scales by much.
    unscaled = scaled(1 / scale)
    shapes = {
        "walls": {"type": "cube", "to_world": scaled(2), "flip_normals": True},
        "sphere": {"type": "sphere", "to_world": at(-1, -1, -1) @ scaled(0.4)},
        "disk": {"type": "disk", "to_world": at(1, -1, -1) @ scaled(0.5)},
        "cylinder": {"type": "cylinder", "to_world": at(-1, 1, -1) @ scaled(0.4)},
        "block": {"type": "cube", "to_world": at(1, 1, -1) @ scaled(0.3)},
        "rectangle": {"type": "rectangle", "to_world": at(0, 0, 1) @ scaled(0.5)},
        "first": instance | {"to_world": at(-1, 0, 0.5) @ unscaled},
        "second": instance | {"to_world": at(1, 0, 0.5) @ unscaled},
    }
    for shape in shapes.values():
        shape["to_world"] = at(shift, shift, shift) @ scaled(scale) @ shape["to_world"]
    return mi.load_dict({"type": "scene", "group": group} | shapes, optimize=False)


SCENES = {
    "wall": lambda: scene_of(mesh(*WALL)),
    "closed box": lambda: scene_of(box(1)),
    "100,000 triangles": lambda: scene_of(wavy_sheet()),
    "300 spheres": lambda: scene_of(*swarm()),
    "one of each": one_of_each,
}


def share_found(coarse: CoarseMesh) -> np.ndarray:
    """Share of new surface points that have a patch, by object."""
    sensors = coarse.scene.sensors()
    points = scatter_points(coarse.scene, coarse.object_ids, 32 * BUDGET, sensors, seed=7)
    found = coarse.find(points)[-1]
    _, shape = np.unique(points.object_id, return_inverse=True)
    n_points = np.bincount(shape, minlength=coarse.object_ids.count)
    return np.bincount(shape, found, len(n_points)) / np.maximum(n_points, 1)


# ---------------------- Number and coverage ----------------------


@pytest.mark.parametrize("name", SCENES)
def test_the_number_of_patches_is_bounded(name):
    coarse = coarse_mesh(SCENES[name](), BUDGET)
    assert BUDGET / 4 <= coarse.n_used <= 2 * BUDGET


@pytest.mark.parametrize("name", SCENES)
def test_surface_points_find_their_patch_again(name):
    coarse = coarse_mesh(SCENES[name](), BUDGET)
    patch, _, found = coarse.find(coarse.points)
    has_patch = coarse.patch_of_point >= 0
    assert np.array_equal(patch[found], coarse.patch_of_point[found])
    assert patch[found].max() < coarse.patches.count
    assert (has_patch & ~found).mean() <= FULL_BUCKETS
    assert (found & ~has_patch).sum() == 0


def test_points_that_sensors_see_have_patches():
    """With as many points as the pre-passes scatter."""
    coarse = coarse_mesh(load(room()), BUDGET, points_per_patch=POINTS_PER_PATCH)
    sensors = coarse.scene.sensors()
    points = scatter_points(coarse.scene, coarse.object_ids, 32 * BUDGET, sensors, seed=7)
    found = coarse.find(points.take(np.flatnonzero(points.seen)))[-1]
    assert found.mean() > 0.95


def test_all_kinds_of_shapes_have_patches():
    coarse = coarse_mesh(one_of_each(), BUDGET)
    assert coarse.object_ids.count == 8
    assert (share_found(coarse) > 0.85).all()


@pytest.mark.parametrize(("scale", "shift"), [(1e-4, 0), (1e5, 0), (1, 1e3), (1e-2, -50)])
def test_patches_depend_neither_on_scale_nor_on_place(scale, shift):
    there, here = (coarse_mesh(one_of_each(*where), BUDGET) for where in ((scale, shift), (1, 0)))
    assert there.n_used == pytest.approx(here.n_used, rel=0.1)
    assert_allclose(share_found(there), share_found(here), atol=0.1)


# ---------------------- Separation ----------------------


def test_the_sides_of_a_wall_have_patches_of_their_own():
    coarse = coarse_mesh(scene_of(mesh(*WALL)), BUDGET)
    side = coarse.points.normal[:, 2] > 0
    front, back = (coarse.patch_of_point[side == s] for s in (True, False))
    assert not set(front[front >= 0]) & set(back[back >= 0])


def test_objects_that_touch_have_patches_of_their_own():
    coarse = coarse_mesh(scene_of(block(0, 0, 0, 1), block(0, 0, 2, 1)), BUDGET)
    owner = coarse.points.object_id == coarse.points.object_id[0]
    ours, theirs = (coarse.patch_of_point[owner == s] for s in (True, False))
    assert not set(ours[ours >= 0]) & set(theirs[theirs >= 0])


# ---------------------- Jittered look-up ----------------------


def plane(x: np.ndarray) -> CoarseMesh:
    """Points on a grid in the plane z = 0, x by even steps in y; one object."""
    y = (np.arange(256) + 0.5) / 128 - 1
    position = np.stack([*np.meshgrid(x, y), np.zeros((len(y), len(x)))], axis=-1).reshape(-1, 3)
    points = surface_points(position, [0, 0, 1])
    return coarse_mesh_over(scene_of(mesh(*WALL)), points, len(points) // 32)


@pytest.fixture(scope="module")
def even_plane(variant) -> CoarseMesh:
    """Patches of equal size."""
    return plane(np.linspace(-1, 1, 256) * (1 - 1e-4))


def middles(coarse: CoarseMesh) -> np.ndarray:
    """The x of the middle of each patch."""
    patch, size, found = coarse.find(coarse.points)
    origin = coarse.patches.origin.numpy()[0, 0]
    middle = origin + (np.floor((coarse.points.position[:, 0] - origin) / size) + 0.5) * size
    result = np.zeros(coarse.patches.count)
    result[patch[found]] = middle[found]
    return result


def places(x: np.ndarray, y: float = 0.0) -> np.ndarray:
    return np.stack([x, np.full_like(x, y), np.zeros_like(x)], axis=1)


def expectation(coarse: CoarseMesh, position: np.ndarray, n_jitters: int = 64) -> np.ndarray:
    """Expected middle at positions [N, 3], by n_jitters² even jitters."""
    jitter = (np.indices((n_jitters, n_jitters)).reshape(2, -1) + 0.5) / n_jitters
    repeated = surface_points(np.repeat(position, n_jitters**2, axis=0), [0, 0, 1])
    patch, _, found = coarse.find(repeated, np.tile(jitter, len(position)))
    assert found.all()
    return middles(coarse)[patch].reshape(len(position), -1).mean(axis=1)


def test_the_jittered_look_up_interpolates_linearly(even_plane):
    """If patches hold the x of their middle, its expectation at x is x; a plain look-up jumps."""
    position = places(np.linspace(-0.3, 0.3, 301))
    patch, size, found = even_plane.find(surface_points(position, [0, 0, 1]))
    assert found.all() and np.ptp(size) == 0
    assert np.abs(middles(even_plane)[patch] - position[:, 0]).max() > 0.45 * size[0]
    interpolated = expectation(even_plane, position)
    assert_allclose(interpolated, position[:, 0], rtol=0, atol=size[0] / 64)


@pytest.mark.xfail(strict=True, reason="large cells of different levels don't blend")
def test_it_has_no_jumps_where_patches_of_two_sizes_meet():
    """Five times as many points on the right half."""
    x = np.concatenate([np.linspace(-1, 0, 60, False), np.linspace(0, 1, 300, False)]) + 1e-3
    coarse = plane(x)
    position = places(np.linspace(-0.15, 0.15, 601))
    _, size, _ = coarse.find(surface_points(position, [0, 0, 1]))
    assert np.ptp(size) > 0
    jumps = np.abs(np.diff(expectation(coarse, position, n_jitters=32)))
    assert jumps.max() < 0.1 * size.min()


def test_jittering_at_the_rim_stays_on_the_surface(even_plane):
    place = surface_points(np.array([[1 - 1e-4, 0, 0]] * 64), [0, 0, 1])
    own = even_plane.find(place)[0][0]
    patch, _, found = even_plane.find(place, np.random.default_rng(5).uniform(size=(2, 64)))
    assert found.all()
    assert own in patch
    near = even_plane.points.position[np.isin(even_plane.patch_of_point, patch)]
    assert (near[:, 0] > 0.8).all()


# ---------------------- Degenerate input ----------------------


def test_degenerate_triangles_do_no_harm():
    """Zero area, NaN positions and NaN normals, beside a wall."""
    vertices = [*WALL[0], [0, 0, 1], [0, 0, 1], [0, 0, 1], [0, 0, np.nan]]
    faces = [*WALL[1], [4, 5, 6], [0, 1, 1], [4, 5, 7]]
    normals = [[0, 0, 1]] * 3 + [[np.nan] * 3] + [[0, 0, 0]] * 4
    for extra in (None, normals):
        coarse = coarse_mesh(scene_of(box(2), mesh(vertices, faces, extra)), BUDGET)
        for name in ("position", "normal", "shading_normal"):
            assert np.isfinite(getattr(coarse.points, name)).all()
        assert np.isfinite(coarse.patches.size.numpy()).all()
        assert (share_found(coarse) > 0.9).any()


@pytest.mark.parametrize(
    "shape",
    [
        lambda: ball(0, 0, 0, 1) | {"bsdf": {"type": "conductor"}},
        lambda: mesh([[0, 0, 0]] * 3, [[0, 1, 2]]),
    ],
    ids=["mirror", "point"],
)
def test_a_scene_without_a_surface_for_the_cache_has_no_patches(shape):
    """Mirrors only, or a single degenerate triangle."""
    coarse = coarse_mesh(scene_of(shape(), sky={"type": "constant"}), BUDGET)
    assert len(coarse.points) == 0
    assert coarse.n_used == 0
    assert not coarse.find(surface_points(np.zeros((1, 3)), [0, 0, 1]))[-1].any()
    assert not coarse.solve().table.numpy().any()


def test_a_handful_of_points_is_enough():
    coarse = coarse_mesh(scene_of(mesh(*WALL)), budget=16, points_per_patch=POINTS_PER_PATCH)
    assert 0 < coarse.n_used <= 2 * 16
