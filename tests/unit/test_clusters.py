"""Clusters: found among the surface points of a scene, or listed by the user."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest

from envmap_integrator.preparation.coarse_mesh.surface_points import SurfacePoints
from envmap_integrator.preparation.maps import clusters as maps_clusters
from envmap_integrator.preparation.maps.clusters import (
    ClusterRequest,
    cluster_of_cell,
    find_clusters,
    listed_clusters,
    shapes_named,
)
from envmap_integrator.system.scene_order import ordered_shapes
from tests.helpers import ball
from tests.unit.kit import scene_of, surface_points

pytestmark = pytest.mark.usefixtures("variant")

RATIO = 2.0
LEFT, RIGHT = np.array([-5.0, 0, 1]), np.array([5.0, 1, 1])


@pytest.fixture(autouse=True)
def counted(monkeypatch):
    """Objects have the numbers here that they are made with."""
    monkeypatch.setattr(maps_clusters, "lasting_ids", lambda shapes: np.arange(len(shapes)))


def floor(seen=1.0) -> SurfacePoints:
    """20 x 20, at z = 0, object 0."""
    x = np.linspace(-10, 10, 60)
    position = np.stack([*np.meshgrid(x, x), np.zeros((60, 60))], axis=-1).reshape(-1, 3)
    return surface_points(position, [0, 0, 1], object_id=0, seen=seen)


def globe(centre, object_id: int, radius: float = 1.0, seen=1.0) -> SurfacePoints:
    normal = np.random.default_rng(object_id).normal(size=(500, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return surface_points(centre + radius * normal, normal, object_id, seen)


def single_space(points: SurfacePoints) -> np.ndarray:
    return np.zeros(len(points), dtype=np.int64)


def found(points: SurfacePoints, distance_ratio: float = RATIO):
    return find_clusters(points, single_space(points), distance_ratio)


def hall(**more) -> SurfacePoints:
    """Two globes far apart over a large floor."""
    return SurfacePoints.concatenate(
        [floor(**more), globe(LEFT, 1, **more), globe(RIGHT, 2, **more)]
    )


# ---------------------- Automatic ----------------------


def test_objects_far_apart_are_clusters_and_the_floor_is_none():
    points = hall()
    clusters, cluster_of_point = found(points)
    assert len(clusters) == 2
    assert (cluster_of_point[points.object_id == 0] == -1).all()
    for object_id, centre in ((1, LEFT), (2, RIGHT)):
        (index,) = set(cluster_of_point[points.object_id == object_id])
        cluster = clusters[index]
        assert cluster.centre == pytest.approx(centre, abs=0.05)
        assert cluster.radius == pytest.approx(1, abs=0.05)
        assert cluster.half_width == pytest.approx(RATIO * cluster.radius)


def test_cubes_hold_their_cluster():
    points = hall()
    clusters, cluster_of_point = found(points, 1.0)
    assert clusters
    for index, cluster in enumerate(clusters):
        offset = np.abs(points.position[cluster_of_point == index] - cluster.centre).max()
        assert offset == pytest.approx(cluster.half_width, rel=1e-5)


def test_what_no_sensor_sees_gets_no_map():
    assert found(hall(seen=0.0))[0] == []


def test_what_lies_in_several_spaces_is_no_cluster():
    points = hall()
    space = np.where(points.position[:, 0] < LEFT[0], 0, 1)
    clusters, cluster_of_point = find_clusters(points, space, RATIO)
    assert len(clusters) == 3
    for index in range(3):
        assert len(set(space[cluster_of_point == index])) == 1


def test_what_is_in_no_known_space_is_no_cluster():
    points = hall()
    space = np.where(points.object_id == 1, -1, 0)
    clusters, cluster_of_point = find_clusters(points, space, RATIO)
    assert len(clusters) == 1
    assert set(cluster_of_point[points.object_id == 1]) == {-1}


def test_a_floor_alone_has_no_cluster():
    clusters, cluster_of_point = found(floor())
    assert clusters == [] and (cluster_of_point == -1).all()


def test_a_cube_that_holds_the_whole_scene_is_no_cluster():
    clusters, cluster_of_point = found(globe(LEFT, 0), distance_ratio=20)
    assert clusters == [] and (cluster_of_point == -1).all()


@pytest.mark.parametrize(("scale", "shift"), [(1e-4, 0.0), (1e5, 0.0), (1.0, 1e4)])
def test_clusters_depend_neither_on_scale_nor_on_place(scale, shift):
    points = hall()
    place = (points.position.astype(np.float64) * scale + shift).astype(np.float32)
    moved = replace(points, position=place)
    here, there = found(points)[0], found(moved)[0]
    assert len(here) == len(there)
    radii = sorted(cluster.radius * scale for cluster in here)
    assert sorted(cluster.radius for cluster in there) == pytest.approx(radii, rel=0.02)


# ---------------------- Listed ----------------------


@pytest.fixture(scope="module")
def scene(variant) -> mi.Scene:
    """Whose shapes are called as its objects here: 0, 1, 2."""
    names = ("floor", "left", "right")
    return mi.load_dict({"type": "scene"} | {name: ball(0, 0, 0, 1) for name in names})


def listed(scene, *requests: ClusterRequest, points: SurfacePoints | None = None):
    points = points or hall()
    return listed_clusters(points, single_space(points), scene, requests, RATIO)


def test_listed_shapes_make_clusters(scene):
    both = ClusterRequest("globes", ("left", "right"), 1.2)
    (cluster,), cluster_of_point = listed(scene, both)
    points = hall()
    assert cluster.name == "globes"
    assert cluster.centre == pytest.approx((LEFT + RIGHT) / 2, abs=0.05)
    assert cluster.half_width == pytest.approx(1.2 * cluster.radius)
    assert np.array_equal(cluster_of_point, np.where(points.object_id > 0, 0, -1))


def test_a_listed_cube_that_holds_the_whole_scene_is_left_out(scene):
    large, small = ClusterRequest("a", ("left",), 100.0), ClusterRequest("b", ("right",), 1.2)
    clusters, cluster_of_point = listed(scene, large, small)
    assert [cluster.name for cluster in clusters] == ["b"]
    assert np.array_equal(cluster_of_point, np.where(hall().object_id == 2, 0, -1))


def test_a_request_may_have_its_own_ratio(scene):
    requests = (ClusterRequest("a", ("left",), 7.0), ClusterRequest("b", ("right",), None))
    ratios = [cluster.half_width / cluster.radius for cluster in listed(scene, *requests)[0]]
    assert ratios == pytest.approx([7, RATIO])


@pytest.mark.parametrize(
    ("requests", "message"),
    [
        ([("desk", "lef")], 'mipmap_cube "desk": the scene has no shape "lef"; it has .*"left"'),
        ([("desk", "left", "left")], 'mipmap_cube "desk": shape "left" is listed twice'),
        ([("a", "left"), ("b", "left")], 'mipmap_cube "b": shape "left" is listed twice'),
    ],
)
def test_wrong_requests_are_named(scene, requests, message):
    requests = [ClusterRequest(name, tuple(ids), None) for name, *ids in requests]
    with pytest.raises(ValueError, match=message):
        listed(scene, *requests)


def test_of_a_listed_shape_what_lies_in_another_space_is_left_out(scene):
    points = hall()
    space = np.where(points.position[:, 0] < LEFT[0] - 0.5, 0, 1)
    both = (ClusterRequest("globes", ("left", "right"), 1.2),)
    _, cluster_of_point = listed_clusters(points, space, scene, both, RATIO)
    member = (points.object_id > 0) & (space == 1)
    assert np.array_equal(cluster_of_point, np.where(member, 0, -1))


def test_a_listed_shape_without_surface_is_left_out(scene):
    """As are mirrors and glass, which get no points, and what is too small to get any."""
    clusters, cluster_of_point = listed(
        scene, ClusterRequest("desk", ("right",), None), points=floor()
    )
    assert clusters == []
    assert (cluster_of_point == -1).all()


def test_shapes_with_names_alike_are_shown_first():
    parts = {name: ball(i, 0, 0, 0.1) for i, name in enumerate(("rug", "wall", "chair-leg", "b"))}
    with pytest.raises(ValueError, match='"chair"; it has "chair-leg", "'):
        shapes_named(scene_of(**parts), ("chair",), "ours")


def test_long_lists_of_shapes_are_cut():
    scene = scene_of(*(ball(i, 0, 0, 0.1) for i in range(20)))
    with pytest.raises(ValueError, match=r'"shape7", … \(20 in all\)'):
        listed(scene, ClusterRequest("desk", ("cup",), None), points=floor())


def test_a_centre_can_be_moved(scene):
    """The cube still holds the cluster: it grows."""
    asked = ClusterRequest("a", ("left",), 1.5, center=(-5.0, 0.0, 2.0))
    (cluster,), _ = listed(scene, asked)
    assert cluster.centre == pytest.approx((-5, 0, 2))
    assert cluster.radius == pytest.approx(2, abs=0.05)
    assert cluster.half_width == pytest.approx(1.5 * cluster.radius)


def test_what_is_excluded_is_in_no_automatic_cluster():
    points = hall()
    clusters, cluster_of_point = find_clusters(
        points, single_space(points), RATIO, points.object_id == 1
    )
    assert len(clusters) == 1
    assert clusters[0].centre == pytest.approx(RIGHT, abs=0.05)
    assert set(cluster_of_point[points.object_id == 1]) == {-1}


def test_shapes_are_found_by_their_ids(scene):
    ids = [shape.id() for shape in ordered_shapes(scene)]
    named = shapes_named(scene, ("right", "left"), "ours")
    assert [ids[number] for number in named] == [name for name in ids if name != "floor"]
    assert len(shapes_named(scene, (), "ours")) == 0


# ---------------------- Cells of the coarse mesh ----------------------


def test_cells_take_the_cluster_of_most_of_their_points():
    """A cell of two clusters, one of one, one of none, one half of none, one without points; a
    point without a cell.
    """
    cluster_of_point = np.array([0, 1, 1, 0, 0, -1, -1, -1, 0, 1])
    cell_of_point = np.array([0, 0, 0, 1, 1, 2, 3, 3, 3, -1])
    patches = SimpleNamespace(levels=mi.UInt32([1] * 5))
    mesh = SimpleNamespace(patches=patches, cell_of_point=cell_of_point)
    assert cluster_of_cell(2, cluster_of_point, mesh).tolist() == [1, 0, 2, 2, 2]
