"""Parts of pictures: the pixels in which chosen shapes are seen."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from compare.metrics import Picture

Mask = NDArray[np.bool_]
"""Which pixels belong to a region, [H, W]."""


def pixel_centres(scene: mi.Scene) -> mi.RayDifferential3f:
    """Camera rays through the centres of all pixels of the first sensor, row by row."""
    sensor = scene.sensors()[0]
    width, height = sensor.film().size()
    index = dr.arange(mi.UInt32, width * height)
    x, y = mi.Float(index % width) + 0.5, mi.Float(index // width) + 0.5
    position = mi.Point2f(x / width, y / height)
    return sensor.sample_ray_differential(0, 0.5, position, mi.Point2f(0.5))[0]


def first_hits(
    scene: mi.Scene, shape_ids: Iterable[str], facing: Sequence[float] | None = None
) -> Mask:
    """Pixels at whose centre a shape with one of these ids is hit first.

    With ``facing``, a unit vector, only where the surface's normal points there. The scene has to
    be loaded unmerged: merged meshes have no ids.
    """
    si = scene.ray_intersect(pixel_centres(scene))
    hit = dr.zeros(mi.Bool, dr.width(si))
    for shape in scene.shapes():
        if shape.id() in set(shape_ids):
            hit |= si.shape == mi.ShapePtr(shape)
    if facing is not None:
        hit &= dr.dot(si.n, mi.Normal3f(facing)) > 0.99
    width, height = scene.sensors()[0].film().size()
    return hit.numpy().reshape(height, width)


def within(picture: Picture, mask: Mask) -> Picture:
    """The pixels of a region in one row, [1, pixels, 3], as metrics take them."""
    return picture[mask][None]


def crop(picture: NDArray, mask: Mask) -> NDArray:
    """The least rectangle of a picture or mask that holds the region."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    return picture[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
