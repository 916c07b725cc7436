"""Every source of light counts exactly once: with and without maps, wherever it is."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from tests.helpers import (
    SCENES,
    assert_agree,
    ball,
    cluster,
    colour,
    emitting,
    grey,
    integrator,
    lamp,
    load,
    load_scene,
    measure,
    open_scene,
    room,
)

pytestmark = pytest.mark.usefixtures("variant")

TABLE = cluster("table-top", *(f"table-leg-{i}" for i in range(1, 5)), "ball")


def assert_maps_keep_the_light(scene, desk, without_maps=True, **settings):
    """A picture with maps has the light of those without, and of ``path``."""
    hybrid = integrator("envmap_hybrid", desk=desk, **settings)
    assert len(hybrid.prepare(scene).maps) == 1
    with_maps = measure(scene, hybrid, spp=256).overall()
    if without_maps:
        one_level = measure(scene, integrator("one_level_path", **settings), spp=256).overall()
        assert_agree(with_maps, one_level, allowed=0.01, precision=0.02)
    path = measure(scene, integrator("path", **settings), spp=256).overall()
    assert_agree(with_maps, path, allowed=0.02, precision=0.02)


@pytest.mark.parametrize("hide_emitters", [False, True])
def test_paper_room(hide_emitters):
    scene = load_scene(SCENES / "paper_room.xml", 32, 24)
    assert_maps_keep_the_light(scene, TABLE, hide_emitters=hide_emitters)


def test_environment_of_the_open_scene():
    scene = load_scene(SCENES / "open.xml", 32, 24, glass="white-glaze")
    assert_maps_keep_the_light(scene, cluster("bench-seat"), without_maps=False)


# Around block and ball, cluster() puts a cube from z = -2.8 to z = -0.3.


def sky() -> dict:
    """A sky with a small bright spot."""
    radiance = np.full((8, 16, 3), 0.5, dtype=np.float32)
    radiance[2, 5] = 40
    return {"type": "envmap", "bitmap": mi.Bitmap(radiance)}


LIGHTS = {
    "lamp-outside-the-cube": lambda: room(),
    "lamp-on-the-cube": lambda: room(lamp=lamp(z=-0.275)),
    "lamp-in-the-cube": lambda: room(lamp=lamp(y=1.2, z=-0.6, half_width=0.2, power=60)),
    "ball-that-shines": lambda: room(
        lamp=None, ball=ball(0.4, 0.2, -1.5, 0.4) | grey(0.5) | emitting(10, 8, 6)
    ),
    "point": lambda: room(lamp={"type": "point", "position": [0, 0, 1.5], "intensity": colour(10)}),
    "point-in-the-cube": lambda: room(
        lamp={"type": "point", "position": [0, 0.2, -0.6], "intensity": colour(10)}
    ),
    "spot": lambda: room(
        lamp={"type": "spot", "to_world": spot_pose(), "intensity": colour(30), "cutoff_angle": 40}
    ),
    "directional": lambda: open_scene(
        lamp={"type": "directional", "direction": [0.3, 0.2, -1], "irradiance": colour(2)}
    ),
    "constant": lambda: open_scene(lamp={"type": "constant", "radiance": colour(0.5, 0.6, 0.8)}),
    "envmap": lambda: open_scene(lamp=sky()),
}


def spot_pose():
    return mi.ScalarTransform4f().look_at([0.5, -0.5, 1.8], [0, 0.3, -2], [0, 1, 0])


@pytest.mark.parametrize("light", LIGHTS)
def test_light(light):
    assert_maps_keep_the_light(load(LIGHTS[light]()), cluster("block", "ball"))


# ---------------------- No map is read ----------------------


@pytest.mark.parametrize("make", [room, lambda: open_scene(lamp=sky())], ids=["room", "open"])
def test_a_cube_larger_than_the_scene_is_one_level_path_tracing(make):
    scene = load(make())
    hybrid = integrator("envmap_hybrid", desk=cluster("block", "ball", distance_ratio=100))
    ours, theirs = (
        measure(scene, renderer, spp=128) for renderer in (hybrid, integrator("one_level_path"))
    )
    assert_agree(ours.overall(), theirs.overall())
    assert_agree(ours.tiles(8), theirs.tiles(8), precision=0.1)
