"""A fixed order of the shapes of a scene."""

from __future__ import annotations

import mitsuba as mi


def ordered_shapes(scene: mi.Scene) -> list[mi.Shape]:
    """The shapes in an order that depends on their content alone.

    Mitsuba merges meshes in parallel: ``scene.shapes()`` comes in another order at every load.
    """
    return sorted(scene.shapes(), key=_key)


def ordered_emitters(scene: mi.Scene) -> list[mi.Emitter]:
    """The emitters in an order that depends on their content alone."""
    order = {shape.ptr: index for index, shape in enumerate(ordered_shapes(scene))}
    emitters = scene.emitters()
    of_shape = [emitter for emitter in emitters if emitter.get_shape() is not None]
    others = [emitter for emitter in emitters if emitter.get_shape() is None]
    return others + sorted(of_shape, key=lambda emitter: order[emitter.get_shape().ptr])


def _key(shape: mi.Shape) -> tuple:
    box = shape.bbox()
    return (*box.min, *box.max, shape.effective_primitive_count(), shape.class_name(), shape.id())
