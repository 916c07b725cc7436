"""The irradiance cache against closed forms."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from numpy.testing import assert_allclose

from envmap_integrator.preparation.coarse_mesh.patch_points import PatchPoints
from envmap_integrator.preparation.radiosity.irradiance import MAX_BOUNCES, TOLERANCE
from tests.helpers import QUANTILE, assert_agree, at, ball, box, emitting, exactly, grey
from tests.unit.kit import WALL, CoarseMesh, coarse_mesh, mean_of, mesh, scene_of

pytestmark = pytest.mark.usefixtures("variant")

BUDGET = 256
SKY = {"type": "constant", "radiance": {"type": "rgb", "value": [1.0, 2.0, 3.0]}}


@dataclass(frozen=True)
class Received:
    """What the patches that hold points receive, and where they are.

    total, indirect    [P, C]  W/m²
    position, normal   [P, 3]  means over a patch's points
    """

    total: np.ndarray
    indirect: np.ndarray
    position: np.ndarray
    normal: np.ndarray


def received(coarse: CoarseMesh, samples: int = 256) -> Received:
    used = np.unique(coarse.patch_of_point[coarse.patch_of_point >= 0])
    table = coarse.solve(samples).table.numpy().reshape(-1, 2, len(mi.Spectrum()))[used]
    assert np.isfinite(table).all() and (table >= 0).all()
    return Received(
        table[:, 0],
        table[:, 1],
        patch_means(coarse, coarse.points.position),
        patch_means(coarse, coarse.points.normal),
    )


def patch_means(coarse: CoarseMesh, values: np.ndarray) -> np.ndarray:
    """Means [P, K] over the points of each patch of values [N, K] at points."""
    kept = coarse.patch_of_point >= 0
    _, patch, n_points = np.unique(
        coarse.patch_of_point[kept], return_inverse=True, return_counts=True
    )
    sums = [np.bincount(patch, weights=column) for column in values[kept].T]
    return np.stack(sums, axis=1) / n_points[:, None]


def in_furnace(albedo: float, samples: int = 1024) -> tuple[Received, np.ndarray]:
    """What patches of a box receive whose walls emit 0.5, and which of them face inwards."""
    coarse = coarse_mesh(scene_of(box(1) | grey(albedo) | emitting(0.5)), BUDGET)
    light = received(coarse, samples)
    return light, (light.position * light.normal).sum(axis=1) < 0


@pytest.mark.parametrize("albedo", [0.0, 0.2, 0.5, 0.8])
def test_a_furnace(albedo):
    """Walls that emit L and reflect ρ receive π L / (1 - ρ), ρ of it indirectly."""
    light, inside = in_furnace(albedo)
    total, indirect = light.total[inside, 0], light.indirect[inside, 0]
    expected = np.pi * 0.5 / (1 - albedo)
    # Each bounce passes on what the solver has left out when it stopped.
    assert_agree(mean_of(total), exactly(expected), allowed=TOLERANCE / (1 - albedo) + 5e-4)
    assert_agree(mean_of(total - indirect), exactly(np.pi * 0.5), allowed=5e-4)
    assert_allclose(total, expected, rtol=0.1)
    assert light.total[~inside].max() < 1e-6 * expected


@pytest.mark.parametrize("albedo", [0.9, 0.99, 0.999])
def test_an_almost_white_furnace(albedo):
    """Hundreds of bounces count there. Each repeats the error of the one before."""
    light, inside = in_furnace(albedo)
    assert_allclose(light.total[inside], np.pi * 0.5 / (1 - albedo), rtol=5e-3)
    assert_allclose(light.indirect[inside], albedo * light.total[inside], rtol=5e-3)


@pytest.mark.parametrize("albedo", [0.9, 0.98])
def test_a_dim_furnace_beside_a_bright_one(albedo):
    """What is left out when the solver stops is little for either."""
    dim = box(1) | grey(albedo) | emitting(1e-8)
    bright = box(1) | grey(0.5) | emitting(1e4)
    bright["to_world"] = at(4, 0, 0) @ bright["to_world"]
    light = received(coarse_mesh(scene_of(dim, bright), BUDGET))
    for centre, expected in ((0, 1e-8 / (1 - albedo)), (4, 1e4 / 0.5)):
        position = light.position - (centre, 0, 0)
        inside = np.all(np.abs(position) < 1.5, axis=1)
        inside &= (position * light.normal).sum(axis=1) < 0
        assert_allclose(light.total[inside], np.pi * expected, rtol=0.02)


def test_a_furnace_that_loses_nothing():
    """It has no finite solution: the light of some bounces is what it gets.

    A few more than are asked for: hits that no patch serves are traced on.
    """
    light, inside = in_furnace(1.0)
    assert_allclose(light.total[inside], np.pi * 0.5 * (MAX_BOUNCES + 2), rtol=0.02)


@pytest.mark.variants("llvm_ad_rgb", "llvm_ad_mono")
@pytest.mark.parametrize("shape", ["sheet", "ball"])
def test_a_convex_shape_under_the_sky(shape):
    """It receives π L everywhere outside, on both sides of a sheet, and nothing indirectly."""
    shape = mesh(*WALL) if shape == "sheet" else ball(0, 0, 0, 1)
    scene = scene_of(shape, sky=SKY)
    light = received(coarse_mesh(scene, BUDGET))
    outside = (light.position * light.normal).sum(axis=1) > -1e-6
    radiance = scene.environment().eval(dr.zeros(mi.SurfaceInteraction3f)).numpy().ravel()
    for ours, sky in zip(light.total[outside].T, radiance, strict=True):
        assert_agree(mean_of(ours), exactly(np.pi * sky), precision=0.005)
    assert not light.total[~outside].any()
    assert not light.indirect.any()


def test_a_sheet_under_a_point_light():
    """E = I h / (h² + r²)^1.5 on the lit side, none on the other."""
    height, intensity, samples = 0.8, 7.0, 256
    lamp = {"type": "point", "position": [0, 0, height], "intensity": intensity}
    coarse = coarse_mesh(scene_of(mesh(*WALL), lamp=lamp), BUDGET)
    light = received(coarse, samples)
    assert not light.indirect.any()

    members = PatchPoints(coarse)
    n_patches, n_draws = len(members.patches), 4096
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(1, n_patches * n_draws)
    rank = dr.arange(mi.UInt32, n_patches * n_draws) // n_draws
    point = members.sample(rank, sampler.next_1d()).numpy()
    x, y, _ = coarse.points.position[point].astype(np.float64).T
    exact = intensity * height / (height**2 + x * x + y * y) ** 1.5
    exact *= coarse.points.normal[point, 2] > 0
    exact = exact.reshape(n_patches, n_draws)
    mean = exact.mean(axis=1)
    assert (mean == 0).any() and not light.total[mean == 0].any()
    # Each ray starts from one of the patch's points at random.
    error = exact.std(axis=1) * np.sqrt(1 / samples + 1 / n_draws)
    assert (np.abs(light.total[:, 0] - mean) <= (QUANTILE + 1) * error + 1e-4 * mean).all()


def test_points_of_fewer_patches():
    """What is sorted for all patches of a mesh needn't be sorted again for some of them."""
    coarse = coarse_mesh(scene_of(box(1) | grey(0.5)), BUDGET)
    dropped = np.arange(coarse.patches.count) % 3 == 0
    mesh_ = coarse.without(dropped)
    ours, expected = PatchPoints(coarse).only(mesh_), PatchPoints(mesh_)
    assert 0 < len(ours.patches) < coarse.n_used
    for name in ("patches", "first", "index", "cells", "rank_of_patch"):
        np.testing.assert_array_equal(getattr(ours, name), getattr(expected, name))
    rank = dr.arange(mi.UInt32, 999) % len(ours.patches)
    sampled = [
        m.sample(rank, dr.linspace(mi.Float, 0, 0.999, 999)).numpy() for m in (ours, expected)
    ]
    np.testing.assert_array_equal(*sampled)


def test_light_between_two_sheets():
    """The lower one is lit by a spot, the upper one only by what comes off it.

    The light that leaves a sheet of reflectance 0.5 is half of what it receives; between large
    sheets nearly all of it arrives at the other one.
    """
    gap = 0.02
    lower, upper = ({"type": "rectangle", "to_world": at(0, 0, z)} | grey(0.5) for z in (0, gap))
    spot = {
        "type": "spot",
        "to_world": mi.ScalarTransform4f().look_at([0, 0, gap / 2], [0, 0, 0], [1, 0, 0]),
        "cutoff_angle": 80,
    }
    light = received(coarse_mesh(scene_of(lower, upper, lamp=spot), BUDGET))
    inner = light.normal[:, 2] * np.where(light.position[:, 2] > gap / 2, -1, 1) > 0
    assert not light.total[~inner].any()
    below = inner & (light.position[:, 2] < gap / 2)
    above = inner & ~below
    assert np.array_equal(light.total[above], light.indirect[above])
    assert (light.total[below] - light.indirect[below]).any()


def test_two_runs_agree_to_the_bit():
    coarse = coarse_mesh(scene_of(box(1) | grey(0.5) | emitting(1)), BUDGET)
    first, second = (coarse.solve(16).table.numpy() for _ in range(2))
    assert np.array_equal(first, second)
