"""Heavy weights of a few rays are lowered where light would grow without end, and only there."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from envmap_integrator.preparation.radiosity.gather import Blocks, GatherRays, without_growth

pytestmark = pytest.mark.usefixtures("variant")


def weights_of(weight: list[float], ends: list[int]) -> np.ndarray:
    """What becomes of the weights of one ray of each patch that ends in another one."""
    n = len(weight)
    none, unknown = mi.Spectrum(0), mi.Float(0)
    row = mi.UInt32([2 * end for end in ends])
    light = mi.Spectrum(mi.Float(weight))
    rays = GatherRays(np.arange(n), none, none, unknown, unknown, light, row, row, row)
    blocks = Blocks(np.arange(n), n)
    calmed = without_growth(rays, blocks, np.arange(n), n)
    return calmed.weight.numpy()[0]


def test_where_others_reflect_less_nothing_is_lost():
    weight = [1.5, 0.6, 0.7, 0.5]
    assert weights_of(weight, ends=[1, 2, 3, 0]) == pytest.approx(weight)


def test_patches_that_see_each_other_alone_do_not_amplify_light():
    found = weights_of([1.2, 1.1, 0.6, 0.5], ends=[1, 0, 3, 2])
    assert found == pytest.approx([0.775, 0.775, 0.6, 0.5])  # The mean, of at most 1 each.


def test_what_ends_in_no_patch_brings_nothing():
    found = weights_of([0.0, 0.9], ends=[0, 0])
    assert found == pytest.approx([0.0, 0.9])
    assert dr.all(mi.Float(found) < 1)
