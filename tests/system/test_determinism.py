"""The same seed gives the same picture: in one process, in two, with any number of threads."""

from __future__ import annotations

import hashlib
import subprocess
import sys

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from compare.gallery import INTEGRATORS
from compare.scene_kit import ball, camera, film, room
from tests.helpers import ROOT, cluster

pytestmark = pytest.mark.usefixtures("variant")

FILTERS = ("box", "gaussian")


def picture(integrator: str, rfilter: str = "box") -> np.ndarray:
    """A new scene with glass and a map, by a new integrator: nothing is prepared yet."""
    glass = ball(0.4, 0.2, -1.6, 0.4) | {"bsdf": {"type": "dielectric"}}
    sensor = camera() | {"film": film(64, 48) | {"rfilter": {"type": rfilter}}}
    scene = mi.load_dict(room(ball=glass, sensor=sensor))
    maps = {"desk": cluster("block")} if integrator == "envmap_hybrid" else {}
    plugin = mi.load_dict({"type": integrator, **maps})
    return np.array(mi.render(scene, integrator=plugin, spp=16, seed=3))


def digest(integrator: str) -> str:
    return hashlib.sha256(picture(integrator).tobytes()).hexdigest()


@pytest.fixture
def threads():
    """``threads(count)`` sets their number; what it was is restored."""
    before = dr.thread_count()
    yield dr.set_thread_count
    dr.set_thread_count(before)


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_two_renders_are_alike(integrator):
    assert np.array_equal(picture(integrator), picture(integrator))


def test_two_processes_render_alike():
    command = [sys.executable, "-m", "tests.system.test_determinism"]
    one, other = (
        subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout
        for _ in range(2)
    )
    assert one.split() == [digest(integrator) for integrator in INTEGRATORS]
    assert one == other


@pytest.mark.parametrize("rfilter", FILTERS)
@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_threads_do_not_change_the_picture(threads, integrator, rfilter):
    """Sums over the samples of a pixel are taken in one order with a box filter. With a wider one,
    samples of several threads meet in a pixel, whose sum is rounded in the order they come in.
    """
    pictures = []
    for count in (1, 2, 5):
        threads(count)
        pictures.append(picture(integrator, rfilter))
    if rfilter == "box":
        allowed = 0.0
    else:
        # A sum of n positive numbers is off by n ε / 2 at most, relative to it. A pixel is one such
        # sum over another, of what lies within two pixels, and both pictures may be off.
        samples = 16 * 5**2
        allowed = 2 * samples * np.finfo(np.float32).eps
    for other in pictures[1:]:
        np.testing.assert_allclose(other, pictures[0], rtol=allowed, atol=0)


if __name__ == "__main__":
    mi.set_variant("llvm_ad_rgb")
    print(*(digest(integrator) for integrator in INTEGRATORS))
