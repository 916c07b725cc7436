"""Recognises whether the content of a scene has changed, in this process and in others."""

from __future__ import annotations

import re
from collections.abc import Iterator
from functools import cache

import drjit as dr
import mitsuba as mi
import numpy as np
from blake3 import blake3

from .behaviour import behaviour
from .spectrum import n_stored

#: What the parts of a fingerprint stand for, in their order.
PARTS = (
    "variant",
    "shapes",
    "materials",
    "emitters",
    "materials or emitters on the same shapes",
)
#: What objects print that differs from load to load: addresses and folders; and numbers, which
#: are parameters, seen without rounding, or derived from them.
_VOLATILE = re.compile(r'0x[0-9a-f]+|filename = ".*"|[-+]?\d+(\.\d+|(\.\d+)?e[-+]\d+)')


class SceneContent:
    """All objects of a scene that its light depends on, and the values of their parameters.

    Contents are equal if they have the same objects, with the same values in the same memory:
    nothing is read for that. What they are told by is held on to, so that no later object or array
    gets its address or index. Sensors and integrators don't belong to it.
    """

    def __init__(self, scene: mi.Scene):
        groups = [child for child in _children(scene) if isinstance(child, mi.Shape)]
        shapes = {shape.ptr: shape for shape in (*scene.shapes(), *groups)}
        self._objects: dict[int, _Object] = {}
        self.shapes = [_object(shape, self._objects) for shape in shapes.values()]
        for emitter in scene.emitters():
            _object(emitter, self._objects)  # Area emitters have come with their shapes.
        self._identity = tuple(item.identity for item in self._objects.values())

    def __eq__(self, other: object) -> bool:
        return isinstance(other, SceneContent) and self._identity == other._identity

    __hash__ = None

    @property
    def in_python(self) -> bool:
        """Is a plugin of it written in Python? What such depend on can't be known."""
        return _in_python(self._objects)

    def of_kind(self, kind: type) -> list[_Object]:
        """Those of all objects that are of a class of Mitsuba's."""
        return [item for item in self._objects.values() if isinstance(item.itself, kind)]


class SensorConstants:
    """What kernels take for granted of a sensor: the objects that it's made of, and their numbers.

    Arrays, such as where it stands, aren't among them if the sensor shows Dr.Jit all of its own.
    What it's told by is held on to.
    """

    #: Others keep arrays to themselves, at least thinlens and orthographic.
    OPEN = ("PerspectiveCamera",)

    def __init__(self, sensor: mi.Sensor):
        self._objects: dict[int, _Object] = {}
        _object(sensor, self._objects)
        if sensor.class_name() in self.OPEN:
            self._constants = [(item.itself.ptr, item.values) for item in self._objects.values()]
        else:
            self._constants = [item.identity for item in self._objects.values()]

    def __eq__(self, other: object) -> bool:
        return isinstance(other, SensorConstants) and self._constants == other._constants

    def __hash__(self) -> int:
        return hash(tuple(self._objects))

    @property
    def in_python(self) -> bool:
        """Is a plugin of it written in Python?"""
        return _in_python(self._objects)


class SceneFingerprint:
    """Content hash of all shapes, materials and emitters of a scene: five ``PARTS``, with dots.

    What is prepared is specific to it. It covers what objects show of themselves (parameters,
    classes, flags, what they print) and, where they hide something, how they behave. The content
    is read only if an object or array of the scene has been replaced since the last call.
    """

    def __init__(self):
        self._content: SceneContent | None = None
        self._digests: _Digests | None = None
        self._hash = ""

    def __call__(self, scene: mi.Scene) -> str:
        return self.of(SceneContent(scene))

    def of(self, content: SceneContent) -> str:
        """The same of a scene whose content has been listed."""
        if content != self._content:
            # Arrays that are still there needn't be read again.
            digests = _Digests(self._digests.arrays if self._digests else {})
            self._hash = ".".join(_parts(content, digests))
            self._content, self._digests = content, digests
        return self._hash


def content_digest(item: mi.Object) -> bytes:
    """Hash of an object and all that is nested in it."""
    return _Digests({}).whole(_object(item, {}))


def difference(theirs: str, ours: str) -> str:
    """In which of their ``PARTS`` fingerprints differ, in words; nothing if that can't be told."""
    parts = theirs.split("."), ours.split(".")
    if not all(len(each) == len(PARTS) for each in parts):
        return ""
    differing = [name for name, a, b in zip(PARTS, *parts, strict=True) if a != b]
    # The last differs with the others.
    return " and ".join(differing[:-1] or differing)


def _parts(content: SceneContent, digests: _Digests) -> Iterator[str]:
    """The ``PARTS``; scenes list their objects in an order that varies from load to load."""

    def all_of(hashes):
        return _digest(*sorted(hashes)).hex()

    yield f"{n_stored()}"
    yield all_of(map(digests.own, content.shapes))
    # Whether shapes share a material or have two that are the same doesn't matter.
    yield all_of(set(map(digests.whole, content.of_kind(mi.BSDF))))
    yield all_of(map(digests.whole, content.of_kind(mi.Emitter)))
    yield all_of(map(digests.whole, content.shapes))


# ---------------------- Walk ----------------------


class _Object:
    """An object of a scene as it is when it's seen.

    itself     the object
    values     numbers and strings by name
    arrays     Dr.Jit arrays by name: the values themselves, not the variables, which edits replace
    children   nested objects: (name, object)
    identity   what it's told by, without reading arrays
    """

    __slots__ = ("arrays", "children", "identity", "itself", "values")

    def __init__(self, itself: mi.Object):
        self.itself = itself
        self.arrays, self.children, self.values = {}, [], {}
        for name, value in _values(itself):
            value = getattr(value, "matrix", value)
            if isinstance(value, mi.Object):
                # Shapes of a group may all have the same name.
                self.children.append((name, value))
            elif value is not None and dr.is_jit_v(value):
                self.arrays[name] = type(value)(value)
            else:
                self.values[name] = _plain(value)
        self.identity = (
            itself.ptr,
            tuple(self.values.items()),
            tuple(map(_index, self.arrays.values())),
            tuple(child.ptr for _, child in self.children),
        )


def _in_python(objects: dict[int, _Object]) -> bool:
    modules = (type(item.itself).__module__ for item in objects.values())
    return not all(module.split(".")[0] == "mitsuba" for module in modules)


def _object(itself: mi.Object, known: dict[int, _Object]) -> _Object:
    """An object with its nested ones, each seen once: shapes share materials and textures."""
    if itself.ptr in known:
        return known[itself.ptr]
    item = known[itself.ptr] = _Object(itself)
    item.children = [(name, _object(child, known)) for name, child in item.children]
    return item


@cache
def _collector() -> type:
    """Class that collects what an object shows; Mitsuba has no classes before it has a variant."""

    class Collector(mi.TraversalCallback):
        def __init__(self):
            super().__init__()
            self.found = []

        def put(self, name, value, flags, cpptype=None):
            self.found.append((name, value, cpptype))

    return Collector


def _values(item: mi.Object) -> Iterator[tuple[str, object]]:
    """Parameters and nested objects of an object; all attributes of one that is made in Python."""
    collector = _collector()()
    item.traverse(collector)
    for name, value, cpptype in collector.found:
        if value is not None and not isinstance(value, mi.Sensor):
            yield name, value if cpptype is None else mi.get_property(value, cpptype, item)
    if isinstance(item, mi.Shape):
        box = item.bbox()
        yield "box", (*box.min, *box.max)
    if isinstance(item, mi.Mesh):
        # Rectangles, for one, don't show them.
        yield "face_indices", item.faces_buffer()
        yield "positions", item.vertex_positions_buffer()
    yield from getattr(item, "__dict__", {}).items()


def _children(scene: mi.Scene) -> list[mi.Object]:
    collector = _collector()()
    scene.traverse(collector)
    return [value for _, value, cpptype in collector.found if cpptype is None]


def _plain(value):
    """A value that can be compared, and printed without rounding; of others, the class alone."""
    if isinstance(value, bool | int | float | str | None):
        return value
    if isinstance(value, tuple | list) or dr.is_array_v(value):
        return tuple(map(_plain, value))
    if isinstance(value, np.ndarray):
        return (value.shape, value.dtype.str, _digest(value.tobytes()))
    return type(value).__qualname__


def _index(array) -> tuple:
    """Identity of an array's data in Dr.Jit."""
    if dr.is_tensor_v(array):
        return (array.array.index, array.shape)
    return tuple(dr.detail.collect_indices(array))


# ---------------------- Hashes ----------------------


class _Digests:
    """Hashes of objects and arrays, each made once.

    ``arrays`` are those of arrays, by their identity in Dr.Jit; ``known`` are some made before.
    """

    def __init__(self, known: dict[tuple, bytes]):
        self._known, self.arrays = known, {}
        self._alone: dict[int, bytes] = {}
        self._whole: dict[int, bytes] = {}

    def whole(self, item: _Object) -> bytes:
        """Hash of an object and all that is nested in it."""
        address = item.itself.ptr
        if address not in self._whole:
            self._whole[address] = b"being made"  # Objects of Python may nest in a circle.
            self._whole[address] = self._with(item, self.whole, item.children)
        return self._whole[address]

    def own(self, shape: _Object) -> bytes:
        """Hash of a shape or a group of shapes without materials and emitters."""
        others = [
            (name, child)
            for name, child in shape.children
            if not isinstance(child.itself, mi.BSDF | mi.Emitter)
        ]
        return self._with(shape, self.own, others)

    def _with(self, item: _Object, of_nested, children: list[tuple[str, _Object]]) -> bytes:
        """Hash of an object with some nested ones; the shapes of a group are in no order."""
        nested = (
            ("" if isinstance(child.itself, mi.Shape) else name, of_nested(child))
            for name, child in children
        )
        parts = (part for name, digest in sorted(nested) for part in (name.encode(), digest))
        return _digest(self._of(item), *parts)

    def _of(self, item: _Object) -> bytes:
        """Hash of an object without what is nested in it."""
        address = item.itself.ptr
        if address not in self._alone:
            arrays = [f"{name}: {type(array).__name__}" for name, array in item.arrays.items()]
            text = "\n".join((*_traits(item.itself), repr(item.values), *arrays))
            content = [self._array(array) for array in item.arrays.values()]
            shown = [_array_digest(array) for array in behaviour(item.itself)]
            self._alone[address] = _digest(text.encode(), *content, *shown)
        return self._alone[address]

    def _array(self, array) -> bytes:
        index = _index(array)
        if index not in self.arrays:
            self.arrays[index] = self._known.get(index) or _array_digest(array)
        return self.arrays[index]


def _traits(item: mi.Object) -> Iterator[str]:
    """What isn't a parameter: classes, flags, and what an object prints of itself."""
    yield f"{type(item).__module__}.{type(item).__qualname__} {item.class_name()}"
    if isinstance(item, mi.BSDF):
        yield f"{item.flags()} {[item.flags(i) for i in range(item.component_count())]}"
    if isinstance(item, mi.Emitter):
        yield f"{item.flags()}"
    if isinstance(item, mi.Shape):
        yield f"flipped {item.has_flipped_normals()}"
    if isinstance(item, mi.Mesh):
        yield f"flat {item.has_face_normals()}"
    # Shapes print nothing else, but of which group an instance is.
    if not isinstance(item, mi.Shape) or item.class_name() == "Instance":
        try:
            yield _VOLATILE.sub("", str(item))
        except RuntimeError:  # Objects of Python needn't be able to.
            pass


def _digest(*parts: bytes) -> bytes:
    digest = blake3()
    for part in parts:
        digest.update(len(part).to_bytes(8, "little"))
        digest.update(part)
    return digest.digest(length=16)


def _array_digest(array) -> bytes:
    """Hash of an array's content."""
    data = np.ascontiguousarray(array.numpy()).reshape(-1).view(np.uint8)
    return blake3(data).digest(length=16)
