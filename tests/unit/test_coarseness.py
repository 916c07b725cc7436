"""What the size of patches does to the picture: it's known, and smaller patches follow."""

from __future__ import annotations

import numpy as np
import pytest

from envmap_integrator.preparation.coarse_mesh.build import build_mesh
from tests.helpers import load, room
from tests.unit.kit import coarse_mesh
from tests.unit.test_noise import behind_a_wall, solutions

pytestmark = pytest.mark.usefixtures("variant")


def test_what_patches_cost_is_known():
    """Patches across the end of a wall bring light behind it, whatever rays are sent.

    How much hangs on where the grid lies: a few sizes stand for all.
    """
    scene = behind_a_wall()
    right, _ = solutions(scene, count=4, budget=16384, samples=64)
    errors, known = [], []
    for budget in (1700, 2048, 2400):
        wrong, _ = solutions(scene, count=2, budget=budget, samples=64)
        errors.append(1 - right.mean() / wrong.mean())
        known.append(coarse_mesh(scene, budget, 32).solution(64).noise.coarseness)
    bias = np.mean([k.bias for k in known])
    assert bias - 3 * np.mean([k.doubt for k in known]) > 0.1
    # To first order: of a large error, it is the lower bound.
    assert np.mean(errors) / 3 < bias < 1.5 * np.mean(errors)
    assert all(k.steep.any() for k in known)
    assert coarse_mesh(scene, 32768, 16).solution(64).noise.coarseness.bias < bias / 1.5


def test_patches_are_small_enough_for_an_ordinary_room():
    coarseness = coarse_mesh(load(room()), 4096, 24).solution(64).noise.coarseness
    assert abs(coarseness.bias) < 0.003
    assert abs(coarseness.steep_bias) < 0.002


def test_steep_cells_are_divided_and_no_others():
    coarse = coarse_mesh(load(room()), 1024, 64)
    levels = coarse.patches.levels.numpy()
    chosen = np.flatnonzero(levels)[::7]
    divided = np.zeros(len(levels), dtype=int)
    divided[chosen] = 1
    finer = build_mesh(coarse.points, coarse.object_ids, 1024, divided)
    patch_of_point, cell_of_point = finer.patch_of_point, finer.cell_of_point
    assert np.array_equal(cell_of_point, coarse.cell_of_point)
    change = finer.patches.levels.numpy().astype(int) - levels
    assert np.array_equal(change, divided)
    inside = divided[cell_of_point] == 1
    assert len(np.unique(patch_of_point[inside])) > 2.5 * len(
        np.unique(coarse.patch_of_point[inside])
    )
    assert len(np.unique(patch_of_point[~inside])) == len(np.unique(coarse.patch_of_point[~inside]))
