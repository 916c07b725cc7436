"""What has happened before a random scene is rendered: another scene, another view, another place.

Whatever an integrator keeps of it, the picture has to be that of the scene as it is now.
"""

from __future__ import annotations

import copy
from typing import Any

import mitsuba as mi
import numpy as np

Recipe = dict[str, Any]


def earlier_scene(recipe: Recipe) -> Recipe | None:
    """Recipe of another scene, which the same integrator has rendered before, if there is one."""
    if recipe["before"] is None:
        return None
    return recipe | recipe["before"] | {"start": None, "before": None}


def first_frame(recipe: Recipe) -> Recipe:
    """A recipe as it was before the camera or a shape has moved."""
    first, start = copy.deepcopy(recipe), recipe["start"]
    if "camera" in start:
        first["sensor"] |= start["camera"]
    if "object" in start:
        item = first["objects"][start["object"]]
        item["at"] = [a - b for a, b in zip(item["at"], start["by"], strict=True)]
    return first


def move(scene: mi.Scene, sensor: mi.Sensor, recipe: Recipe, goal) -> None:
    """Make the scene of ``first_frame`` that of the recipe; ``goal`` is the sensor's pose then."""
    start = recipe["start"]
    if "camera" in start:
        values = mi.traverse(sensor)
        values["to_world"] = mi.Transform4f(goal.matrix)
        values.update()
    if "object" in start:
        by = [recipe["scale"] * c for c in start["by"]]
        _move_shape(mi.traverse(scene), f"object{start['object']}", by)


def _move_shape(values: mi.SceneParameters, name: str, by: list[float]) -> None:
    """Move a shape or all instances of it, by a vector."""
    moved = 0
    for key in values.keys():
        owner, _, parameter = key.partition(".")
        if owner != name and not owner.startswith(f"{name}copy"):
            continue
        if parameter == "to_world":
            values[key] = mi.Transform4f().translate(by) @ values[key]
        elif parameter == "vertex_positions":
            values[key] = _shifted(values[key], by)
        elif parameter == "control_points":
            values[key] = _shifted(values[key], [*by, 0])
        else:
            continue
        moved += 1
    assert moved, f"{name} has nothing that places it"
    values.update()


def _shifted(numbers: mi.Float, by: list[float]) -> mi.Float:
    return mi.Float(numbers.numpy() + np.tile(by, len(numbers) // len(by)).astype(np.float32))
