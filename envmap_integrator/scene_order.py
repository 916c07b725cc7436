"""A fixed order of the shapes of a scene."""

from __future__ import annotations

import mitsuba as mi


def ordered_shapes(scene: mi.Scene) -> list[mi.Shape]:
    """The shapes in an order that depends on their content alone.

    Mitsuba merges meshes in parallel: ``scene.shapes()`` comes in another order at every load.
    """
    return sorted(scene.shapes(), key=_key)


def _key(shape: mi.Shape) -> tuple:
    box = shape.bbox()
    return (*box.min, *box.max, shape.effective_primitive_count(), shape.class_name(), shape.id())
