"""A shape of a scene that moves from frame to frame, and what of the picture stands still."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

#: Samples per pixel by which pixels are found that see neither the shape nor its shadow.
MASK_SPP = 64

Shot = Callable[[], Any]
"""Puts the scene in order for a frame, and gives the sensor to render."""


def shots(scene: mi.Scene, shape_id: str, widths: float, n_frames: int) -> list[Shot]:
    """Frames in which a shape moves to the right as the first sensor sees it.

    In all by ``widths`` times its own width, of which half lies on either side of where it is.
    Raises ``ValueError`` if the scene has no such shape, or it can't be moved.
    """
    params = mi.traverse(scene)
    names = [f"{shape_id}.to_world", f"{shape_id}.vertex_positions"]
    key = next((name for name in names if name in params), None)
    if key is None:
        raise ValueError(f'--moving: the scene has no shape "{shape_id}" that can be moved')
    box = next(shape for shape in scene.shapes() if shape.id() == shape_id).bbox()
    to_world = np.array(scene.sensors()[0].world_transform().matrix).reshape(4, 4)
    right = -to_world[:3, 0]  # Mitsuba's sensors look along z, with x to the left.
    width = widths * float(np.abs(right) @ np.array(box.max - box.min))
    first = type(params[key])(params[key])

    def shot(way: float) -> mi.Sensor:
        offset = way * width * right
        if key.endswith("to_world"):
            params[key] = mi.Transform4f().translate(offset.tolist()) @ first
        else:
            moved = np.array(first).reshape(-1, 3) + offset.astype(np.float32)
            params[key] = mi.Float(moved.ravel())
        params.update()
        return scene.sensors()[0]

    ways = np.linspace(-0.5, 0.5, n_frames)
    return [lambda way=float(way): shot(way) for way in ways]


def static(scene: mi.Scene, frames: list[Shot]) -> NDArray[np.bool_]:
    """Pixels [H, W] that see neither what moves nor its shadow.

    By direct light alone, with the same random numbers in all frames, they are the same in all.
    """
    direct = mi.load_dict({"type": "path", "max_depth": 2})
    pictures = []
    for frame in frames:
        sensor = frame()
        picture = mi.render(scene, sensor=sensor, integrator=direct, spp=MASK_SPP, seed=0)
        pictures.append(np.array(picture))
    return np.all(np.stack(pictures) == pictures[0], axis=(0, 3))
