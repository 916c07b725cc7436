"""Light from where a material reflects more of it counts for more."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from envmap_integrator.preparation.coarse_mesh.surface_points import scatter_points
from envmap_integrator.preparation.radiosity.incidence import STEPS, Incidence
from tests.unit.kit import ObjectIds, scene_of

pytestmark = pytest.mark.usefixtures("variant")

COSINE = np.sqrt((np.arange(STEPS) + 0.5) / STEPS)


def factors(bsdf: dict, turned: bool = False) -> np.ndarray:
    """By step of the squared cosine, of a sphere of a material, or of its inside."""
    scene = scene_of({"type": "sphere", "flip_normals": turned, "bsdf": bsdf})
    points = scatter_points(scene, ObjectIds.of(scene), 64, [])
    outside = np.flatnonzero((points.position * points.normal).sum(axis=1) > 0)
    point = dr.full(mi.UInt32, int(outside[0]), STEPS)
    return Incidence(points)(point, mi.Float(COSINE)).numpy()


@pytest.mark.parametrize("kind", ["diffuse", "roughconductor"])
def test_all_counts_alike_where_the_cache_serves_no_coat(kind):
    assert (factors({"type": kind}) == 1).all()


@pytest.mark.parametrize(
    "bsdf",
    [
        {"type": "plastic"},
        {"type": "roughplastic", "alpha": 0.3},
        {"type": "twosided", "bsdf": {"type": "plastic"}},
    ],
)
def test_even_light_counts_as_much_as_before(bsdf):
    found = factors(bsdf)
    assert found.mean() == pytest.approx(1, abs=1e-5)
    assert found.std() > 0.01


def test_a_coat_lets_less_light_in_at_grazing_angles():
    """The diffuse part of a smooth plastic is the product of the coat's transmissions."""
    transmitted = 1 - np.array([mi.fresnel(mi.Float(c), 1.49)[0][0] for c in COSINE])
    found = factors({"type": "plastic"})[1:] / transmitted[1:]  # The first step is a steep one.
    assert found.std() < 0.01 * found.mean()


@pytest.mark.parametrize("kind", ["blend", "principled"])
def test_gloss_does_not_count(kind):
    """What the cache serves of these is as good as diffuse: it counts all light alike."""
    blend = {"type": "blendbsdf", "weight": 0.5, "a": {"type": "diffuse"}}
    kinds = {
        "blend": blend | {"b": {"type": "roughconductor", "alpha": 0.2}},
        "principled": {"type": "principled", "roughness": 0.8},
    }
    np.testing.assert_allclose(factors(kinds[kind]), 1, atol=2e-3)


def test_each_side_has_its_own():
    sides = {"front": {"type": "diffuse"}, "back": {"type": "plastic"}}
    bsdf = {"type": "twosided"} | sides
    assert factors(bsdf).std() < 0.01 < factors(bsdf, turned=True).std()
