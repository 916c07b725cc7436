"""Look-ups beyond a cube: level, corrected direction, bounds, sources."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from numpy.testing import assert_allclose

from envmap_integrator.lookup.cube import face_to_direction, n_levels
from envmap_integrator.lookup.cube_map import Cluster, CubeMap
from envmap_integrator.lookup.far_field import HAND_OFF, FarField, far_field
from envmap_integrator.preparation.maps.mipmap import build_levels
from tests.helpers import at, block, grey, lamp, load, scaled
from tests.unit.kit import scene_of

pytestmark = pytest.mark.usefixtures("variant")

RESOLUTION = 64
CENTRE = np.array([0.5, -0.25, 1.0])
#: Half the edges of the room around the origin, and of the cube in it.
ROOM, CUBE = np.array([3.0, 4.0, 2.5]), 0.6


@pytest.fixture
def random():
    return np.random.default_rng(8)


# ---------------------- Maps and look-ups by hand ----------------------


def texel_directions(resolution: int = RESOLUTION) -> np.ndarray:
    """Unit directions [6, R, R, 3] of the texels' centres."""
    face, y, x = (i.ravel() for i in np.indices((6, resolution, resolution)))
    uv = mi.Point2f((2 * np.stack([x, y]) + 1) / resolution - 1)
    d = dr.normalize(face_to_direction(mi.UInt32(face), uv)).numpy().T
    return d.reshape(6, resolution, resolution, 3)


def wall_points(origin: np.ndarray, d: np.ndarray) -> np.ndarray:
    """Where rays [..., 3] hit the walls of the room."""
    with np.errstate(divide="ignore"):
        t = ((np.sign(d) * ROOM - origin) / d).min(axis=-1, keepdims=True)
    return origin + t * d


def constant_levels(*value: float) -> list[np.ndarray]:
    sizes = (RESOLUTION >> level for level in range(n_levels(RESOLUTION)))
    return [np.full((6, size, size, 4), value, np.float32) for size in sizes]


def numbered_levels(inverse_distance: float) -> list[np.ndarray]:
    """Each level shows its number."""
    levels = constant_levels(0, 0, 0, inverse_distance)
    for number, level in enumerate(levels):
        level[..., :3] = number
    return levels


def room_levels() -> list[np.ndarray]:
    """The room's walls show where they are: radiance is position."""
    point = wall_points(CENTRE, texel_directions())
    distance = np.linalg.norm(point - CENTRE, axis=-1, keepdims=True)
    levels = build_levels(np.concatenate([point, 1 / distance], -1), np.ones(point.shape[:-1]))
    return [level.astype(np.float32) for level in levels]


def field_of(levels, scene=None, n_samples=1, mip_bias=0.0, corrected=True, mirrors=False):
    """The far field of one map; cell 0 is in its cluster, cell 1 in none."""
    cube_map = CubeMap(Cluster("cluster", CENTRE, CUBE / 2, CUBE), levels)
    clusters = np.array([0, 1], dtype=np.uint32)
    scene = scene or scene_of()
    return far_field(scene, (cube_map,), clusters, n_samples, mip_bias, corrected, mirrors)


def rays_from_the_cube(random, count: int) -> tuple[np.ndarray, np.ndarray]:
    d = random.normal(size=(count, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    return CENTRE + random.uniform(-CUBE, CUBE, (count, 3)), d


def look_up(
    field: FarField, o, d, pdf=1.0, specular=False, u_level=0.0
) -> tuple[np.ndarray, np.ndarray]:
    """Radiance [N, 3] along rays, at the middle of a texel, and whether it's trusted."""
    count = len(d)
    radiance, trusted = field.eval(
        mi.UInt32(0),
        mi.Ray3f(
            mi.Point3f(np.broadcast_to(o, (count, 3)).T.astype(np.float32)),
            mi.Vector3f(d.T.astype(np.float32)),
        ),
        mi.Float(pdf),
        mi.Bool(specular),
        mi.Float(u_level),
        mi.Point2f(0.5),
        dr.full(mi.Bool, True, count),
    )
    return radiance.numpy().T, np.broadcast_to(trusted.numpy(), count)


# ---------------------- Level ----------------------


@pytest.mark.parametrize("corrected", [True, False])
@pytest.mark.parametrize("inverse_distance", [0.0, 1e-3, 0.2])
@pytest.mark.parametrize("pdf", [0.0, 1e-6, 0.1, 1e6])
def test_a_constant_map_is_constant_whatever_the_look_up(random, corrected, inverse_distance, pdf):
    field = field_of(constant_levels(1, 2, 3, inverse_distance), corrected=corrected)
    o, d = rays_from_the_cube(random, 1000)
    for u_level in (0.0, 0.999):
        radiance, trusted = look_up(field, o, d, pdf, u_level=u_level)
        assert_allclose(radiance, np.broadcast_to([1, 2, 3], radiance.shape), rtol=1e-6)
        assert trusted.all()


def test_maps_may_differ_in_resolution():
    """Each is read where it lies, at its own levels."""
    maps = tuple(
        CubeMap(
            Cluster(f"cluster{value}", CENTRE, CUBE / 2, CUBE),
            [
                np.full((6, size >> i, size >> i, 4), (value + i, value, 0, 0), np.float32)
                for i in range(n_levels(size))
            ],
        )
        for value, size in ((10, 4), (20, 32), (30, 8))
    )
    field = far_field(scene_of(), maps, np.zeros(1, np.uint32), 1, 0.0, True, False)
    for pdf, levels in ((1e9, (0, 0, 0)), (0, (2, 5, 3))):
        radiance, _ = field.eval(
            mi.UInt32([0, 1, 2]),
            mi.Ray3f(mi.Point3f(CENTRE), mi.Vector3f(0.6, 0.0, [0.8, 0.8, -0.8])),
            mi.Float(pdf),
            mi.Bool(False),
            mi.Float(0),
            mi.Point2f(0.5),
            mi.Bool([True] * 3),
        )
        expected = [10 + levels[0], 20 + levels[1], 30 + levels[2]]
        assert radiance.numpy()[0].tolist() == expected
        assert radiance.numpy()[1].tolist() == [10, 20, 30]


def mean_level(field: FarField, o, d, **options) -> np.ndarray:
    """Expected level [N] over the random rounding."""
    rounds = (np.arange(256, dtype=np.float32) + 0.5) / 256
    levels, _ = look_up(
        field, o, np.repeat(d, len(rounds), axis=0), u_level=np.tile(rounds, len(d)), **options
    )
    return levels[:, 0].reshape(len(d), -1).mean(axis=1)


@pytest.mark.parametrize(
    ("n_samples", "pdf", "bias"), [(1, 0.1, 0), (16, 0.1, 0), (64, 0.3, 0), (64, 0.3, 1.5)]
)
def test_a_texel_covers_what_a_sample_stands_for(n_samples, pdf, bias):
    """The texel's solid angle, 4^level times the finest one's, is 1 / (N pdf)."""
    d = texel_directions(4).reshape(-1, 3)
    field = field_of(numbered_levels(0), n_samples=n_samples, mip_bias=bias)
    uv = d / np.abs(d).max(axis=1, keepdims=True)
    finest = 4 / RESOLUTION**2 / (uv**2).sum(axis=1) ** 1.5
    expected = 0.5 * np.log2(1 / (n_samples * pdf) / finest) + bias
    expected = np.clip(expected, 0, n_levels(RESOLUTION) - 1)
    assert_allclose(mean_level(field, CENTRE, d, pdf=pdf), expected, atol=1 / 128)


def test_mirrors_read_the_finest_level():
    d = texel_directions(4).reshape(-1, 3)
    radiance, _ = look_up(field_of(numbered_levels(0)), CENTRE, d, pdf=0.0, specular=True)
    assert not radiance.any()


def test_the_level_accounts_for_the_distance_from_the_origin():
    """A sample's cone is (t / D)² as wide seen from the centre as from a point at distance t."""
    distance, offset = 2.0, 0.5
    field = field_of(numbered_levels(1 / distance))
    axis = np.array([[1.0, 0, 0]])
    central = mean_level(field, CENTRE, axis)
    for side in (1, -1):
        t = distance - side * offset
        shifted = mean_level(field, CENTRE + side * offset * axis[0], axis)
        assert_allclose(shifted - central, np.log2(t / distance), atol=1 / 64)


# ---------------------- Direction ----------------------


def test_the_corrected_look_up_finds_the_wall(random):
    o, d = rays_from_the_cube(random, 20_000)
    found, trusted = look_up(field_of(room_levels()), o, d, specular=True)
    truth = wall_points(o, d)
    distance = np.linalg.norm(truth - CENTRE, axis=1)
    error = np.linalg.norm(found - truth, axis=1) / distance
    # Half the diagonal of a texel seen at the room's most oblique angle is about 0.06.
    assert np.median(error) < 2 / RESOLUTION
    assert np.quantile(error[trusted], 0.99) < 0.1
    assert trusted.mean() > 0.97


def test_the_plain_look_up_sees_what_lies_behind_the_exit_from_the_cube(random):
    o, d = rays_from_the_cube(random, 20_000)
    plain, trusted = look_up(field_of(room_levels(), corrected=False), o, d, specular=True)
    with np.errstate(divide="ignore"):
        t = ((np.sign(d) * CUBE - (o - CENTRE)) / d).min(axis=-1, keepdims=True)
    direction = o + t * d - CENTRE
    shown = wall_points(CENTRE, direction / np.linalg.norm(direction, axis=1, keepdims=True))
    assert trusted.all()
    assert np.median(np.linalg.norm(plain - shown, axis=1)) < 8 / RESOLUTION

    truth = wall_points(o, d)
    corrected, _ = look_up(field_of(room_levels()), o, d, specular=True)
    dislocation = np.linalg.norm(shown - truth, axis=1).mean()
    assert np.linalg.norm(plain - truth, axis=1).mean() == pytest.approx(dislocation, rel=0.05)
    assert np.linalg.norm(corrected - truth, axis=1).mean() < 0.2 * dislocation


def test_a_wrong_distance_is_not_trusted(random):
    """Where neighbouring directions see near and far things by turns."""
    levels = constant_levels(1, 1, 1, 0)
    levels[0][..., 3] = random.choice([1 / 1.5, 1 / 15], levels[0].shape[:-1])
    o, d = rays_from_the_cube(random, 2000)
    _, trusted = look_up(field_of(levels), o, d, specular=True)
    assert 0.2 < trusted.mean() < 0.8


# ---------------------- Bounds ----------------------


def bound(field, o, d, cell=0, wide=True, u=0.0):
    count = len(d)
    everywhere = dr.full(mi.Bool, True, count)
    ray = mi.Ray3f(mi.Point3f(o.T.astype(np.float32)), mi.Vector3f(d.T.astype(np.float32)))
    cube = field.cube(dr.full(mi.UInt32, cell, count), ray.o, everywhere)
    bounded, maxt, reach = field.bound(cube, ray, mi.Bool(wide), mi.Float(u), everywhere)
    return bounded.numpy(), maxt.numpy(), reach.numpy()


def test_rays_end_at_their_cube_or_a_little_beyond(random):
    field = field_of(constant_levels(1, 1, 1, 0))
    o, d = rays_from_the_cube(random, 1000)
    for u in (0.0, 1.0):
        bounded, maxt, reach = bound(field, o, d, u=u)
        assert bounded.all()
        assert_allclose(maxt, reach * (1 + HAND_OFF * u), rtol=1e-6)
        assert_allclose(np.abs(o + reach[:, None] * d - CENTRE).max(axis=1), CUBE, rtol=1e-5)


@pytest.mark.parametrize(
    ("options", "why"), [({"cell": 1}, "belongs to no cluster"), ({"wide": False}, "a mirror")]
)
def test_rays_that_no_map_can_serve_are_traced_in_full(random, options, why):
    field = field_of(constant_levels(1, 1, 1, 0))
    bounded, maxt, reach = bound(field, *rays_from_the_cube(random, 100), **options)
    assert not bounded.any()
    assert (maxt > 1e30).all()
    assert np.isinf(reach).all()


def test_rays_from_outside_their_cube_are_traced_in_full(random):
    o, d = rays_from_the_cube(random, 100)
    field = field_of(constant_levels(1, 1, 1, 0), mirrors=True)
    assert not bound(field, o + [2 * CUBE, 0, 0], d)[0].any()


def test_mirrors_may_read_the_map_and_count_all_sources(random):
    field = field_of(constant_levels(1, 1, 1, 0), mirrors=True)
    bounded, _, reach = bound(field, *rays_from_the_cube(random, 100), wide=False)
    assert bounded.all()
    assert np.isinf(reach).all()


# ---------------------- Sources ----------------------


def reached(scene: mi.Scene, towards) -> tuple[mi.SurfaceInteraction3f, bool]:
    field = field_of(constant_levels(1, 1, 1, 0), scene, mirrors=True)
    ray = mi.Ray3f(mi.Point3f(0, 0, 0), mi.Vector3f(*map(float, towards)))
    si, found = field.intersect_emitters(scene, ray, mi.Bool(True))
    dr.eval(si, found)  # While the scene of the sources is there.
    return si, bool(found.numpy().any())


def lit_hall(**more) -> mi.Scene:
    return load({"type": "scene", "lamp": lamp(z=2), "stage": block(0, 0, -2, 0.5)} | more)


def test_a_source_is_reached():
    scene = lit_hall()
    si, found = reached(scene, (0, 0, 1))
    assert found
    assert si.t.numpy() == pytest.approx(2)
    assert dr.all(si.emitter(scene) == scene.emitters()[0])


@pytest.mark.parametrize("towards", [(1, 0, 0), (0, 0, -1)])
def test_other_directions_reach_none(towards):
    assert not reached(lit_hall(), towards)[1]


def test_a_source_behind_something_is_not_reached():
    screen = {"type": "rectangle", "to_world": at(0, 0, 1) @ scaled(0.5)} | grey(0.5)
    assert not reached(lit_hall(screen=screen), (0, 0, 1))[1]


@pytest.mark.parametrize(("towards", "visible"), [((1, 0, 0), True), ((0, 0, -1), False)])
def test_the_environment_is_a_source(towards, visible):
    """With other sources and without; the stage hides it below."""
    for lamps in ({}, {"lamp": lamp(z=2)}):
        scene = load({"type": "scene", "stage": block(0, 0, -2, 0.5), "sky": SKY} | lamps)
        si, found = reached(scene, towards)
        assert found == visible
        assert not si.is_valid().numpy().any()


SKY = {"type": "constant"}


def test_the_scene_keeps_the_ids_of_its_sources():
    scene = lit_hall()
    field_of(constant_levels(1, 1, 1, 0), scene, mirrors=True)
    assert sorted(shape.id() for shape in scene.shapes()) == ["lamp", "stage"]
    assert reached(scene, (0, 0, 1))[1]


def test_without_maps_there_is_no_far_field():
    assert far_field(scene_of(), (), np.zeros(0, np.uint32), 1, 0.0, True, False) is None
