"""Directions, faces and texels of cube maps."""

from __future__ import annotations

import itertools

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy import stats

from envmap_integrator.lookup import cube

pytestmark = pytest.mark.usefixtures("variant")

#: Axes, edges and corners of a cube.
SPECIAL = np.array([d for d in itertools.product((-1.0, 0.0, 1.0), repeat=3) if any(d)])
ROUNDING = 4 * np.finfo(np.float32).eps
RESOLUTIONS = (1, 2, 16)


def random_directions(count: int) -> np.ndarray:
    d = np.random.default_rng(1).normal(size=(count, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def directions() -> np.ndarray:
    """[N, 3] random ones, and such as lie on borders or almost."""
    return np.concatenate(
        [random_directions(2000), SPECIAL, SPECIAL + 1e-7, SPECIAL - [0, 0, 1e-30]]
    )


def vector(values: np.ndarray) -> mi.Vector3f:
    return mi.Vector3f(np.asarray(values, dtype=np.float32).T)


# ---------------------- Directions and faces ----------------------


@pytest.mark.parametrize("length", [1e-10, 1.0, 1e10])
def test_directions_survive_the_round_trip(length):
    d = directions()
    face, uv = cube.direction_to_face(vector(d * length))
    assert dr.all(face < 6)
    assert dr.all(dr.abs(uv) <= 1, axis=None)
    back = cube.face_to_direction(face, uv).numpy().T
    assert_allclose(back, d / np.abs(d).max(axis=1, keepdims=True), rtol=0, atol=ROUNDING)


def test_faces_are_numbered_by_axis_and_sign():
    face, uv = cube.direction_to_face(vector([s * a for a in np.eye(3) for s in (1, -1)]))
    assert face.numpy().tolist() == [0, 1, 2, 3, 4, 5]
    assert not uv.numpy().any()


def test_points_off_a_face_lie_on_its_neighbour():
    face, uv = cube.direction_to_face(
        cube.face_to_direction(mi.UInt32(0), mi.Point2f([1.25, 0.5], [0.5, -1.25]))
    )
    assert face.numpy().tolist() == [2, 5]  # +x goes over to +y and to -z.


# ---------------------- Texels ----------------------


@pytest.mark.parametrize("resolution", RESOLUTIONS)
def test_texels_of_all_levels_and_faces_are_numbered_in_their_order(resolution):
    indices = []
    for level in range(cube.n_levels(resolution)):
        size = resolution >> level
        face, y, x = (i.ravel() for i in np.indices((6, size, size)))
        centre = (2 * np.stack([x, y]) + 1) / size - 1
        uv = mi.Point2f(centre.astype(np.float32))
        indices.append(cube.texel(mi.UInt32(face), uv, mi.UInt32(resolution), mi.UInt32(size)))
    indices = np.concatenate([index.numpy() for index in indices])
    assert np.array_equal(indices, np.arange(cube.n_texels(resolution)))


@pytest.mark.parametrize("uv", [(-1, -1), (1, 1), (1 + 1e-6, -1 - 1e-6), (3, -3), (np.nan, np.nan)])
def test_no_texel_lies_outside_the_map(uv):
    size = mi.UInt32(4)
    index = cube.texel(mi.UInt32([0, 5]), mi.Point2f(*uv), size, size).numpy()
    assert np.array_equal(index // 16, [0, 5])


# ---------------------- Solid angles ----------------------


@pytest.mark.parametrize("resolution", [1, 2, 64, 1024])
def test_solid_angles_add_up_to_the_sphere(resolution):
    assert 6 * cube.solid_angles(resolution).sum() == pytest.approx(4 * np.pi, rel=1e-12)


def test_solid_angles_are_the_shares_of_uniform_directions():
    resolution, count = 4, 200_000
    face, uv = cube.direction_to_face(vector(random_directions(count)))
    size = mi.UInt32(resolution)
    hits = np.bincount(cube.texel(face, uv, size, size).numpy(), minlength=6 * resolution**2)
    expected = np.tile(cube.solid_angles(resolution).ravel(), 6) / (4 * np.pi) * count
    assert stats.chisquare(hits, expected).pvalue > 0.001


def test_the_solid_angle_at_a_texels_centre_is_second_order():
    """4 / R² / (1 + u² + v²)^1.5, with which levels are chosen and densities are computed."""

    def error(resolution):
        centre = (2 * np.arange(resolution) + 1) / resolution - 1
        u, v = np.meshgrid(centre, centre)
        approximation = 4 / resolution**2 / (1 + u * u + v * v) ** 1.5
        return np.abs(approximation / cube.solid_angles(resolution) - 1).max()

    assert error(64) < 3e-4
    assert error(32) / error(64) == pytest.approx(4, rel=0.05)


# ---------------------- Where rays leave a cube ----------------------


def exit_distance(centre, half_width, origins, towards) -> np.ndarray:
    centre = mi.Point3f(*map(float, centre))
    return cube.exit_distance(
        centre, mi.Float(half_width), vector(origins), vector(towards)
    ).numpy()


def all_pairs(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return np.repeat(a, len(b), axis=0), np.tile(b, (len(a), 1))


def test_rays_leave_the_unit_cube_where_the_slabs_say():
    """From the centre, faces, edges and corners, and from inside; zero components included."""
    inside = np.random.default_rng(2).uniform(-1, 1, (100, 3))
    origins, towards = all_pairs(np.concatenate([inside, SPECIAL, np.zeros((1, 3))]), directions())
    origins, towards = origins.astype(np.float32), towards.astype(np.float32)
    with np.errstate(divide="ignore", invalid="ignore"):
        slabs = np.where(towards == 0, np.inf, (np.sign(towards) - origins) / towards)
    expected = slabs.min(axis=1)
    assert np.isfinite(expected).all()
    assert_allclose(exit_distance((0, 0, 0), 1, origins, towards), expected, rtol=1e-6)


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize("shift", [0.0, 30.0])
def test_rays_end_on_the_surface_at_any_scale(scale, shift):
    centre = shift * scale * np.array([1, -2, 0.5])
    origins, towards = all_pairs(random_directions(50) * 0.9, directions())
    origins = (centre + scale * origins).astype(np.float32)
    t = exit_distance(centre, scale, origins, towards)
    end = (origins + t[:, None] * towards - centre.astype(np.float32)) / scale
    assert t.min() > 0
    assert_allclose(np.abs(end).max(axis=1), 1, atol=(1 + 100 * shift) * 1e-6)


def test_rays_from_outside_have_no_exit():
    origins, towards = all_pairs(SPECIAL * (1 + 1e-6), SPECIAL)
    assert (exit_distance((0, 0, 0), 1, origins, towards) < 0).all()


# ---------------------- Any cube, any ray ----------------------

#: Rounding of single precision, and how many roundings a result has gone through at most.
EPSILON, ROUNDINGS = np.finfo(np.float32).eps, 4


@st.composite
def cubes_and_rays(draw):
    """Cubes, and rays from inside, from faces, edges and corners; zero components included."""
    half_width = np.float32(draw(st.sampled_from([1e-4, 1e-2, 1.0, 7.3, 1e3, 1e5])))
    place = draw(st.sampled_from([0.0, 1.0, 100.0, 1e4]))
    fractions = st.one_of(st.sampled_from([-1.0, 0.0, 1.0]), st.floats(-1, 1))
    vectors = st.tuples(fractions, fractions, fractions)
    centre = np.float32(place * half_width * np.array(draw(vectors)))
    rays = draw(
        st.lists(
            st.tuples(vectors, vectors.filter(lambda d: max(map(abs, d)) > 1e-6)),
            min_size=1,
            max_size=20,
        )
    )
    within, towards = (np.array(part) for part in zip(*rays, strict=True))
    origins = np.float32(centre + half_width * within)
    return centre, half_width, origins, np.float32(towards)


def double(*values):
    return (np.asarray(value, np.float64) for value in values)


def rounding_error(centre, half_width) -> np.float64:
    """Of a coordinate of a cube's surface [world units]."""
    return ROUNDINGS * EPSILON * (np.abs(centre).max() + half_width)


PROPERTIES = settings(max_examples=200, derandomize=True, deadline=None, database=None)


@PROPERTIES
@given(cubes_and_rays())
def test_exits_are_those_of_double_precision(case):
    t = exit_distance(*case).astype(np.float64)
    centre, half_width, origins, towards = double(*case)
    error = rounding_error(centre, half_width)
    assert not np.isnan(t).any()
    depth = half_width - np.abs(origins - centre).max(axis=1)
    assert (t[depth > error] >= 0).all()
    assert (t[depth < -error] < 0).all()
    with np.errstate(divide="ignore", invalid="ignore"):
        slabs = (centre + np.copysign(half_width, towards) - origins) / towards
        width = error / np.abs(towards) + ROUNDINGS * EPSILON * np.abs(slabs)
        low, high = (
            np.where(towards == 0, np.inf, slabs + sign * width).min(axis=1) for sign in (-1, 1)
        )
    inside = t >= 0
    assert (low[inside] <= t[inside]).all() and (t[inside] <= high[inside]).all()


@PROPERTIES
@given(cubes_and_rays())
def test_no_ray_slips_through_a_cube(case):
    """What starts inside ends on the surface, however it is placed."""
    t = exit_distance(*case).astype(np.float64)
    centre, half_width, origins, towards = double(*case)
    error = rounding_error(centre, half_width)
    inside = np.abs(origins - centre).max(axis=1) <= half_width - error
    t, origins, towards = t[inside], origins[inside], towards[inside]
    assert np.isfinite(t).all() and (t > 0).all()
    end = np.abs(origins + t[:, None] * towards - centre)
    # Twice: the error of t, and that of the end it leads to.
    assert (np.abs(end.max(axis=1) - half_width) <= 2 * error).all()


@PROPERTIES
@given(cubes_and_rays())
def test_faces_are_those_of_double_precision(case):
    *_, towards = case
    face, uv = cube.direction_to_face(vector(towards))
    (d,) = double(towards)
    rows, axis = np.arange(len(d)), face.numpy() // 2
    major = d[rows, axis]
    assert (np.abs(major) == np.abs(d).max(axis=1)).all()
    assert np.array_equal(face.numpy() % 2 == 1, major < 0)
    expected = np.stack([d[rows, (axis + k) % 3] for k in (1, 2)]) / np.abs(major)
    assert_allclose(uv.numpy(), expected, rtol=ROUNDINGS * EPSILON, atol=1e-37)


def test_directions_of_texels_lead_back_to_them():
    d = cube.texel_directions(4).reshape(-1, 3).T.astype(np.float32)
    index = cube.texel(*cube.direction_to_face(mi.Vector3f(d)), mi.UInt32(4), mi.UInt32(4))
    assert index.numpy().tolist() == list(range(6 * 16))
