"""Random numbers of the pre-passes, and that loops with them are traced once."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
from scipy.stats import chisquare

from envmap_integrator.lookup.ids import ObjectIds
from envmap_integrator.preparation.coarse_mesh import surface_points
from envmap_integrator.system.random_numbers import RandomNumbers

pytestmark = pytest.mark.usefixtures("variant")

N = 1 << 16


def drawn(seed: int) -> np.ndarray:
    """Six numbers [6, N] of each lane."""
    numbers = RandomNumbers.of_lanes(seed, N)
    return np.concatenate(
        [[numbers.next_1d().numpy()], *(numbers.next_2d().numpy() for _ in range(2)),
         [numbers.next_1d().numpy()]]
    )  # fmt: skip


def test_numbers_are_uniform_and_independent():
    a, b = drawn(1), drawn(2)
    assert a.min() >= 0 and a.max() < 1
    for row in (*a, *b):
        assert chisquare(np.histogram(row, 64, (0, 1))[0]).pvalue > 1e-4
    # Of a lane, of its neighbours, and of another seed.
    rows = np.concatenate([a, np.roll(a, 1, axis=1), np.roll(a, 16, axis=1), b])
    correlation = np.corrcoef(rows) - np.eye(len(rows))
    assert np.abs(correlation).max() < 5 / np.sqrt(N)
    for x, y in ((a[0], a[5]), (a[1], a[2]), (a[0], np.roll(a[0], 1)), (a[0], b[0])):
        counts = np.histogram2d(x, y, 16, ((0, 1), (0, 1)))[0]
        assert chisquare(counts.ravel()).pvalue > 1e-4


def test_numbers_depend_on_lane_and_seed_alone():
    np.testing.assert_array_equal(drawn(7), drawn(7))
    assert (drawn(7) != drawn(8)).mean() > 0.999


def test_loops_over_hits_are_traced_once(monkeypatch):
    """Tracing takes as long as the rays: state that stays the same would have it done twice."""
    scene = mi.load_dict(mi.cornell_box())
    traced, asked = [], surface_points.diffuse_normal
    monkeypatch.setattr(
        surface_points, "diffuse_normal", lambda *args: traced.append(1) or asked(*args)
    )
    calls, along = [], surface_points._hits_along
    monkeypatch.setattr(
        surface_points,
        "_hits_along",
        lambda *args, **named: calls.append(1) or along(*args, **named),
    )
    surface_points.scatter_points(scene, ObjectIds.of(scene), 4096, scene.sensors())
    assert len(traced) == len(calls) >= 2
