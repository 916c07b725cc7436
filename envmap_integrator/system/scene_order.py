"""A fixed order of the shapes of a scene, and ids that last while others move."""

from __future__ import annotations

from itertools import groupby

import mitsuba as mi
import numpy as np
from blake3 import blake3

from .fingerprint import content_digest

#: Bits of a lasting id: as many as the names of patches have room for.
ID_BITS = 25


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


def lasting_ids(ordered: list[mi.Shape]) -> np.ndarray:
    """An id [S] of ``ID_BITS`` for each of the shapes of a scene, as ``ordered_shapes`` has them.

    It's a hash of a shape's box and kind: that of one that stands still stays the same while others
    move, which changes the order. No two are the same.
    """
    taken: dict[int, None] = {}
    for shape in ordered:
        digest = blake3(repr(_key(shape)).encode()).digest(length=4)
        its = int.from_bytes(digest, "little") % (1 << ID_BITS)
        while its in taken:  # Shapes in the same place, or by chance.
            its = (its + 1) % (1 << ID_BITS)
        taken[its] = None
    return np.array([*taken], dtype=np.uint32)


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
