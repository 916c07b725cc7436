"""Recognises whether the content of a scene has changed, in this process and in others."""

from __future__ import annotations

import hashlib
from concurrent.futures import ThreadPoolExecutor

import drjit as dr
import mitsuba as mi
import numpy as np

from .scene_order import ordered_shapes

#: Bytes that a thread hashes at a time.
BLOCK = 1 << 22


class SceneFingerprint:
    """Content hash of the parameters of all shapes, materials and emitters of a scene.

    Sensors and films don't count: what is prepared serves every view. The content is read only
    if an array of the scene has been replaced since the last call.
    """

    def __init__(self):
        self._arrays = ()
        self._indices = ()
        self._scalars = ""
        self._hash = ""

    def __call__(self, scene: mi.Scene) -> str:
        arrays, scalars = _parameters(scene)
        indices = tuple(_index(array) for array in arrays)
        if indices != self._indices or scalars != self._scalars or not self._hash:
            digest = hashlib.blake2b(scalars.encode(), digest_size=16)
            known: dict[tuple, bytes] = {}
            with ThreadPoolExecutor() as pool:
                for array, index in zip(arrays, indices, strict=True):
                    if index not in known:  # Shapes share materials and textures.
                        known[index] = _digest(array, pool)
                    digest.update(known[index])
            # Holding on to the arrays keeps Dr.Jit from giving their indices to others.
            self._arrays, self._indices, self._scalars = arrays, indices, scalars
            self._hash = digest.hexdigest()
        return self._hash


def _digest(array, pool: ThreadPoolExecutor) -> bytes:
    """Hashes of an array's content, block by block: by several threads if there are several."""
    data = np.ascontiguousarray(array.numpy()).reshape(-1).view(np.uint8)
    blocks = [data[begin : begin + BLOCK] for begin in range(0, len(data), BLOCK)]
    # Handing a small array to a thread takes ten times as long as hashing it.
    each = pool.map if len(blocks) > 1 else map
    return b"".join(each(lambda block: hashlib.blake2b(block, digest_size=16).digest(), blocks))


def _parameters(scene: mi.Scene) -> tuple[tuple, str]:
    """Dr.Jit arrays and a text of everything else."""
    # Area emitters come with their shapes.
    environment = [emitter for emitter in scene.emitters() if emitter.get_shape() is None]
    arrays, scalars = [], [f"{len(mi.Spectrum())} channels"]
    for item in (*ordered_shapes(scene), *environment):
        scalars.append(f"{item.class_name()}")
        if isinstance(item, mi.Shape):
            scalars.append(str(item.bbox()))
        for name, value in mi.traverse(item):
            if dr.is_array_v(value) and dr.is_jit_v(value):
                scalars.append(name)
                # The value itself, not the scene's variable, which edits replace.
                arrays.append(type(value)(value))
            else:
                scalars.append(f"{name}={value}")
    return tuple(arrays), "\n".join(scalars)


def _index(array) -> tuple:
    """Identity of an array's data in Dr.Jit."""
    if dr.is_tensor_v(array):
        return (array.array.index, array.shape)
    if dr.depth_v(array) > 1:
        return tuple(_index(component) for component in array)
    return (array.index,)
