"""Chi² tests of the directions that the pre-passes send rays in.

Those of ``mipmap_cube`` are in ``test_mipmap_cube``.
"""

from __future__ import annotations

import itertools
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy import stats

from envmap_integrator.lookup.cube import direction_to_face
from envmap_integrator.lookup.cube_map import Cluster
from envmap_integrator.preparation.coarse_mesh.surface_points import _global_lines
from envmap_integrator.preparation.maps.bake import bake_maps
from envmap_integrator.preparation.radiosity import gather, irradiance
from envmap_integrator.system.jit import SpareNumbers
from envmap_integrator.transport import state
from tests.helpers import ball, grey
from tests.unit.kit import coarse_mesh, scene_of, surface_points

pytestmark = pytest.mark.usefixtures("variant")

#: Chance that a test of a true sampler fails.
SIGNIFICANCE = 0.001


def assert_uniform(*sets: np.ndarray, bins: int) -> None:
    """Each set of points [N, K] fills the unit cube evenly (with Šidák's correction)."""
    p_values = []
    for u in sets:
        counts, _ = np.histogramdd(u, bins=bins, range=[(0, 1)] * u.shape[1])
        assert counts.sum() == len(u)
        p_values.append(stats.chisquare(counts.ravel()).pvalue)
    assert min(p_values) > 1 - (1 - SIGNIFICANCE) ** (1 / len(sets))


def on_sphere(d: np.ndarray) -> np.ndarray:
    """Directions [N, 3] as points [N, 2] of the unit square, the area preserved."""
    turn = np.arctan2(d[:, 1], d[:, 0]) / (2 * np.pi) + 0.5
    return np.clip(np.stack([turn, 0.5 * d[:, 2] + 0.5], axis=1), 0, 1)


def on_hemisphere(d: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Directions [N, 3] above normals [N, 3] as points [N, 2], evenly spread if by the cosine."""
    frame = mi.Frame3f(mi.Normal3f(normal.T.astype(np.float32)))
    local = frame.to_local(mi.Vector3f(d.T.astype(np.float32))).numpy().T
    turn = np.arctan2(local[:, 1], local[:, 0]) / (2 * np.pi) + 0.5
    return np.clip(np.stack([turn, local[:, 2] ** 2], axis=1), 0, 1)


# ---------------------- Global lines ----------------------

CENTRE, RADIUS = np.array([0.5, -1.0, 2.0]), 2.0


class Numbers:
    """A sampler of given numbers [K]."""

    def __init__(self, numbers):
        self.numbers = iter(numbers)

    def next_1d(self) -> mi.Float:
        return next(self.numbers)

    def next_2d(self) -> mi.Point2f:
        return mi.Point2f(next(self.numbers), next(self.numbers))


GLOBE = np.array([[*CENTRE, RADIUS]], dtype=np.float32)
"""A single sphere that lines go through."""


def entries(ray: mi.Ray3f) -> tuple[np.ndarray, np.ndarray]:
    """Where lines enter the bounding sphere, as directions [N, 3] from its centre, and theirs."""
    o, d = ((v.numpy().T).astype(np.float64) for v in (ray.o, ray.d))
    o = (o - CENTRE) / RADIUS
    b = (o * d).sum(axis=1)
    root = b * b - (o * o).sum(axis=1) + 1
    assert root.min() > -1e-5
    return o - (b + np.sqrt(np.maximum(root, 0)))[:, None] * d, d


def test_global_lines_go_in_all_directions():
    test = mi.chi2.ChiSquareTest(
        domain=mi.chi2.SphericalDomain(),
        sample_func=lambda u: _global_lines(GLOBE, Numbers(u), dr.width(u))[0].d,
        pdf_func=lambda d: dr.full(mi.Float, 1 / (4 * np.pi), dr.width(d)),
        sample_dim=4,
        sample_count=400_000,
        res=51,
    )
    assert test.run(significance_level=SIGNIFICANCE, quiet=True), test.messages


def test_global_lines_hit_surfaces_in_proportion_to_their_area():
    """They enter the sphere anywhere, and from a direction as it leaves a Lambertian surface."""
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(3, 400_000)
    point, d = entries(_global_lines(GLOBE, sampler, 400_000)[0])
    place, direction = on_sphere(point), on_hemisphere(d, -point)
    assert_uniform(place, direction, bins=32)
    assert_uniform(np.concatenate([place, direction], axis=1), bins=8)


# ---------------------- Gather rays ----------------------

SAMPLES = 16
NORMAL = np.array([1.0, -2.0, 2.0]) / 3


@pytest.fixture
def gathered(monkeypatch):
    """First rays of a gathering over a tilted plate: direction [P, SAMPLES, 3] and density."""
    seen = []

    def follow(scene, lookup, rules, sampler, start, active):
        assert active.numpy().mean() > 0.999  # Rounding may take a ray below the surface.
        seen.append((start.ray.d.numpy().T, start.pdf.numpy()))
        black = dr.zeros(mi.Spectrum, dr.width(start.ray))
        row = dr.zeros(mi.UInt32, dr.width(start.ray))
        return state.PathEnd(black, black, black, row, row, mi.Bool(False), mi.Float(dr.inf))

    monkeypatch.setattr(gather, "follow", follow)
    turned = mi.ScalarTransform4f().look_at([0, 0, 0], NORMAL.tolist(), [0, 0, 1])
    plate = {"type": "rectangle", "to_world": turned} | grey(0.5)
    coarse = coarse_mesh(scene_of(plate), budget=4096, points_per_patch=32)
    upper = coarse.points.normal @ NORMAL > 0
    coarse = replace(coarse, patch_of_point=np.where(upper, coarse.patch_of_point, -1))
    for seed in range(16):
        irradiance.solve_irradiance(
            coarse.scene,
            coarse.lookup(),
            coarse,
            SAMPLES,
            seed=seed << 16,
        )
    d, pdf = (np.concatenate(values) for values in zip(*seen, strict=True))
    return d.reshape(-1, SAMPLES, 3), pdf.reshape(-1, SAMPLES)


def test_gather_rays_go_out_by_the_cosine(gathered):
    """Each one of a patch's rays, over all patches."""
    d, pdf = gathered
    np.testing.assert_allclose(pdf, d @ NORMAL / np.pi, atol=1e-5)
    normals = np.broadcast_to(NORMAL, d[:, 0].shape)
    assert_uniform(*(on_hemisphere(d[:, k], normals) for k in range(SAMPLES)), bins=16)


def test_the_gather_rays_of_a_patch_are_spread_evenly(gathered):
    """Their mean cosine varies far less than that of random ones, by 0.236 / √N."""
    d, _ = gathered
    assert (d @ NORMAL).mean(axis=1).std() < 0.25 * 0.236 / np.sqrt(SAMPLES)


@pytest.mark.parametrize("n_patches", [20_000, 1_000_000])
def test_rotated_points_are_uniform(n_patches):
    """Those of the gather rays and of the shadow rays, over patches."""
    rank = dr.arange(mi.UInt32, n_patches)
    points = []
    for k, seed in ((0, 1), (5, 1 << 16), (31, 7)):
        lattice = mi.Float(k / 32), mi.radical_inverse_2(mi.UInt32(k), 0)
        for x, y in (lattice, (mi.Float(k * gather.R2[0]), mi.Float(k * gather.R2[1]))):
            points.append(gather._rotated(x, y, rank, seed).numpy().T)
    assert_uniform(*points, bins=16)


# ---------------------- Bake rays ----------------------


def test_bake_rays_fill_texels_evenly():
    """Uniform in (u, v) within each texel, from the cube's centre but starting on the cube."""
    resolution, samples, bins = 4, 8192, 8
    cluster = Cluster("cluster", CENTRE, 0.5, 1.5)
    rays = []

    def record(sampler, ray, active):
        rays.append((ray.o.numpy().T, ray.d.numpy().T))
        return mi.Spectrum(1), mi.Float(1)

    point = surface_points(CENTRE[None] + [0, 0, 0.5], [0, 0, 1])
    scene = scene_of(ball(0, 0, 9, 1))
    bake_maps(scene, record, [cluster], [point], resolution, samples, seed=5)
    o, d = (np.concatenate(values) for values in zip(*rays, strict=True))
    np.testing.assert_allclose(np.linalg.norm(d, axis=1), 1, rtol=1e-5)
    along = (o - CENTRE) / np.linalg.norm(o - CENTRE, axis=1, keepdims=True)
    np.testing.assert_allclose(along, d, atol=1e-5)
    np.testing.assert_allclose(np.abs(o - CENTRE).max(axis=1), cluster.half_width, rtol=1e-5)

    face, uv = direction_to_face(mi.Vector3f(d.T))
    face, grid = face.numpy(), (uv.numpy().T * 0.5 + 0.5) * resolution
    texel = np.minimum(grid.astype(int), resolution - 1)
    index = (face * resolution + texel[:, 1]) * resolution + texel[:, 0]
    counts = np.bincount(index, minlength=6 * resolution**2)
    # Rounding may take a ray across a border.
    np.testing.assert_allclose(counts, samples, atol=3)
    inside = np.minimum(((grid - texel) * bins).astype(int), bins - 1)
    cell = (index * bins + inside[:, 1]) * bins + inside[:, 0]
    counts = np.bincount(cell, minlength=6 * resolution**2 * bins**2)
    p = stats.chisquare(counts, ddof=6 * resolution**2 - 1).pvalue
    assert SIGNIFICANCE < p < 1 - SIGNIFICANCE


# ---------------------- Spare numbers ----------------------


def test_spare_numbers_are_uniform_and_independent():
    """Those that move look-ups: each, and any two. They repeat after 2²⁴ samples."""
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(11, 100_000)
    spare = SpareNumbers(sampler.next_1d())
    numbers = np.stack([spare.next_1d().numpy() for _ in range(6)], axis=1)
    assert numbers.min() >= 0 and numbers.max() < 1
    assert_uniform(*(numbers[:, i : i + 1] for i in range(6)), bins=256)
    assert_uniform(*(numbers[:, p] for p in itertools.combinations(range(6), 2)), bins=16)
