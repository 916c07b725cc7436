"""50 random scenes, always the same; ``python -m tests.fuzz.scenes`` goes through many others."""

from __future__ import annotations

import os

import mitsuba as mi
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings

from tests.fuzz.history import first_frame, move
from tests.fuzz.rooms import wall_material
from tests.fuzz.scenes import (
    SHAPES,
    Palette,
    applicable_mistake,
    check,
    load_scene,
    recipes,
    rotation,
    sensor_of,
)
from tests.helpers import Description, load

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


def plain_recipe(**more):
    """A ball in a room."""
    item = {
        "shape": "sphere",
        "at": [0.5, 0.2, -1],
        "size": 0.4,
        "turn": [1, 0, 0, 30],
        "seed": 1,
        "instances": 0,
        "bsdf": {"type": "diffuse"},
        "radiance": None,
    }
    light = {"type": "area", "power": 1.0, "at": [0, 0, 1.8], "towards": [0, 0, -1]}
    pose = {"origin": [0, -1.8, 0.4], "target": [0, 0, 0]}
    recipe = {
        "integrator": "one_level_path",
        "parameters": {},
        "objects": [item],
        "room": "closed",
        "gap": 0.1,
        "wall": 0.7,
        "bumps": None,
        "plain": False,
        "lights": [light],
        "sensor": pose | {"type": "perspective", "fov": 80, "crop": None},
        "scale": 100.0,
        "offset": [30, -20, 100],
        "cubes": [],
        "baker": None,
        "mistake": None,
        "before": None,
        "start": None,
        "given": None,
    }
    return recipe | more


@pytest.mark.parametrize("given", [None, {}])
@pytest.mark.parametrize("copies", [0, 3])
@pytest.mark.parametrize("shape", SHAPES)
def test_what_has_moved_is_where_the_recipe_puts_it(shape, copies, given):
    start = {"camera": {"origin": [1, 1, 1]}, "object": 0, "by": [0.3, -1.0, 0.1]}
    recipe = plain_recipe(start=start, given=given)
    recipe["objects"][0] |= {"shape": shape, "instances": copies}
    scene, sensor = load_scene(first_frame(recipe))
    there, _ = load_scene(recipe)

    assert not np.allclose(corners(scene), corners(there), rtol=1e-4)
    move(scene, sensor, recipe, sensor_of(recipe)["to_world"])
    np.testing.assert_allclose(corners(scene), corners(there), rtol=1e-4)
    pose = np.array(mi.traverse(sensor)["to_world"].matrix).squeeze()
    np.testing.assert_allclose(pose, np.array(sensor_of(recipe)["to_world"].matrix), rtol=1e-4)


def corners(scene: mi.Scene) -> list[list[float]]:
    boxes = [shape.bbox() for shape in scene.shapes()]
    return sorted([*box.min, *box.max] for box in boxes)


@pytest.mark.parametrize("kind", ["bumpmap", "normalmap"])
@pytest.mark.parametrize("scale", [1.0, 100.0])
def test_bumps_of_walls_are_seen(kind, scale):
    """A wall that's lit from one side shows them by a scatter of its pixels."""

    def scatter(bumps):
        description: Description = {
            "type": "scene",
            "sun": {"type": "directional", "direction": [1, 0, -1]},
            "wall": {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(2 * scale)}
            | wall_material(0.5, bumps, scale),
            "sensor": sensor_of(plain_recipe(scale=scale, offset=[0, 0, 0])),
        }
        picture = mi.render(load(description), integrator=mi.load_dict({"type": "path"}), spp=64)
        seen = np.array(picture).mean(axis=-1)[-3:]
        return seen.std() / seen.mean()

    assert scatter(None) < 1e-3
    weak, strong = (scatter({"type": kind, "height": h, "seed": 0}) for h in (0.1, 1.0))
    assert 0.03 < weak < strong
    assert strong > 0.2
