"""Rooms around the objects of random scenes; all reach from -2 to 2, and walls may have bumps."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np

from tests.helpers import at, grey, scaled

#: Half of an edge of a room, and thickness of walls that have one.
REACH, THICK = 2.0, 0.1
#: How large grounds are that are as large as a plain.
PLAIN = 1e5 * REACH
#: Texels along an edge of a wall's bumps.
BUMPS = 16


def room_parts(recipe: dict[str, Any], place) -> dict[str, dict]:
    """Shapes of a recipe's room; ``place`` is where it lies."""
    scale = recipe["scale"]
    wall = wall_material(recipe["wall"], recipe["bumps"], scale)
    parts: dict[str, dict] = {}
    kind = recipe["room"]
    if kind in ("closed", "gap"):
        parts["walls"] = {"type": "cube", "flip_normals": True, "to_world": place @ scaled(REACH)}
    if kind == "gap":
        low = [-THICK / 2, -REACH, -REACH + recipe["gap"]]
        parts["partition"] = _plate(place, low, [THICK / 2, REACH, REACH])
    if kind == "window":
        parts |= {f"wall{i}": _plate(place, *corners) for i, corners in enumerate(_window_walls())}
    below = -REACH - 2 * THICK if kind == "window" else -REACH - THICK
    if kind == "open":
        size = PLAIN if recipe["plain"] else 3 * REACH
        parts["walls"] = _ground(place, -REACH, size)
    elif recipe["plain"]:
        parts["plain"] = _ground(place, below, PLAIN)
    return {name: part | wall for name, part in parts.items()}


def wall_material(reflectance: float, bumps: dict | None, scale: float) -> dict:
    """Of diffuse walls, flat or with bumps; heights grow with the scene's ``scale``."""
    if not bumps:
        return grey(reflectance)
    random = np.random.default_rng(bumps["seed"])
    inner = {"inner": grey(reflectance)["bsdf"]}
    if bumps["type"] == "bumpmap":
        heights = _texture(random.random((BUMPS, BUMPS, 1)))
        bsdf = {"type": "bumpmap", "heights": heights, "scale": bumps["height"] * scale}
    else:
        normals = random.uniform(-1, 1, (BUMPS, BUMPS, 3)) * bumps["height"]
        normals[..., 2] = 1
        normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
        bsdf = {"type": "normalmap", "normalmap": _texture(0.5 + 0.5 * normals)}
    return {"bsdf": bsdf | inner}


def _texture(texels: np.ndarray) -> dict:
    return {"type": "bitmap", "bitmap": mi.Bitmap(texels.astype(np.float32)), "raw": True}


def _window_walls() -> list[tuple[list[float], list[float]]]:
    """Corners of the walls of a room with a window on the side of +y; edges overlap."""
    a, b, c, h = REACH, REACH + THICK, REACH + THICK / 2, REACH / 2
    return [
        ([-b, -b, -b], [b, b, -a]),
        ([-b, -b, a], [b, b, b]),
        ([-b, -b, -c], [-a, b, c]),
        ([a, -b, -c], [b, b, c]),
        ([-c, -b, -c], [c, -a, c]),
        ([-c, a, -c], [c, b, -h]),
        ([-c, a, h], [c, b, c]),
        ([-c, a, -h], [-h, b, h]),
        ([h, a, -h], [c, b, h]),
    ]


def _plate(place, low: list[float], high: list[float]) -> dict:
    low, high = np.array(low), np.array(high)
    middle, half = (low + high) / 2, (high - low) / 2
    to_world = place @ at(*middle) @ mi.ScalarTransform4f().scale(half.tolist())
    return {"type": "cube", "to_world": to_world}


def _ground(place, height: float, size: float) -> dict:
    return {"type": "rectangle", "to_world": place @ at(0, 0, height) @ scaled(size)}
