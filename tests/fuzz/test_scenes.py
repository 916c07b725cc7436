"""50 random scenes, always the same; ``python -m tests.fuzz.scenes`` goes through many others."""

from __future__ import annotations

import os

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings

from tests.fuzz.scenes import Palette, applicable_mistake, check, recipes, rotation

pytestmark = pytest.mark.usefixtures("variant")

#: Number of scenes, for a longer run.
COUNT = int(os.environ.get("ENVMAP_FUZZ_SCENES", 50))
#: Plugins of which the scenes are made; with all of them, compilation would take minutes.
PALETTES = 5


@pytest.mark.slow
@pytest.mark.parametrize("number", range(PALETTES))
def test_random_scenes(number):
    @settings(
        max_examples=-(-COUNT // PALETTES),
        derandomize=True,
        database=None,
        deadline=None,
        suppress_health_check=list(HealthCheck),
    )
    @given(recipes(Palette.of(number)))
    def passes(recipe):
        check(recipe)

    passes()


@pytest.mark.parametrize("axis", [[1, 0, 0], [1, 1, 1]])
def test_objects_are_turned_without_shearing(axis):
    matrix = np.array(rotation([*axis, 50.0]).matrix)
    np.testing.assert_allclose(matrix @ matrix.T, np.eye(4), atol=1e-6)


def test_mistakes_are_only_those_that_an_integrator_can_make():
    recipe = {"mistake": "cluster", "integrator": "path"}
    assert applicable_mistake(recipe) is None
    assert applicable_mistake(recipe | {"integrator": "envmap_hybrid"}) == "cluster"
