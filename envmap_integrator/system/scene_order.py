"""A fixed order of the shapes of a scene."""

from __future__ import annotations

from itertools import groupby

import mitsuba as mi

from .fingerprint import content_digest


def ordered_shapes(scene: mi.Scene) -> list[mi.Shape]:
    """The shapes in an order that depends on their content alone.

    Mitsuba merges meshes in parallel: ``scene.shapes()`` comes in another order at every load.
    """
    ordered = []
    for _, tied in groupby(sorted(scene.shapes(), key=_key), key=_key):
        tied = list(tied)
        # Reading all that they are takes long, and is seldom needed.
        ordered += sorted(tied, key=content_digest) if len(tied) > 1 else tied
    return ordered


def ordered_emitters(scene: mi.Scene) -> list[mi.Emitter]:
    """The emitters in an order that depends on their content alone."""
    order = {shape.ptr: index for index, shape in enumerate(ordered_shapes(scene))}
    emitters = scene.emitters()
    of_shape = [emitter for emitter in emitters if emitter.get_shape() is not None]
    others = [emitter for emitter in emitters if emitter.get_shape() is None]
    others.sort(key=content_digest)
    return others + sorted(of_shape, key=lambda emitter: order[emitter.get_shape().ptr])


def _key(shape: mi.Shape) -> tuple:
    box = shape.bbox()
    return (*box.min, *box.max, shape.effective_primitive_count(), shape.class_name())
