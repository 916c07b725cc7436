"""What camera rays find."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import pytest

from envmap_integrator.transport.camera import CameraSample
from envmap_integrator.transport.gathered import Gathered

pytestmark = pytest.mark.usefixtures("variant")


def test_samples_that_are_not_finite_are_black():
    """Else one of them would spoil its pixel, and those that share with it."""
    radiance = mi.Spectrum(mi.Float([1, dr.nan, dr.inf]), mi.Float([2, 1, 1]), mi.Float([3, 1, 1]))
    gathered = Gathered(
        radiance=radiance,
        albedo=mi.Spectrum(0.5),
        normal=mi.Vector3f(0, 0, mi.Float([1, dr.nan, 1])),
        position=mi.Vector3f(1),
        nearness=mi.Float(1),
        weight=mi.Float(1),
    )
    found = CameraSample(radiance, mi.Float(1), mi.Bool(True), gathered).finite()
    assert found.radiance.numpy().T.tolist() == [[1, 2, 3], [0, 0, 0], [0, 0, 0]]
    assert found.gathered.weight.numpy().tolist() == [1, 0, 0]
    assert all(dr.all(dr.isfinite(value)) for value in found.gathered.channels())
