"""The order of shapes and emitters depends on what they are, not on where a scene lists them."""

from __future__ import annotations

import itertools

import mitsuba as mi
import pytest

from envmap_integrator.system.fingerprint import SceneFingerprint, content_digest
from envmap_integrator.system.scene_order import ordered_emitters, ordered_shapes
from tests.helpers import at, emitting, grey, load, room

pytestmark = pytest.mark.usefixtures("variant")

#: Parts that Mitsuba's bounding boxes don't tell apart.
PARTS = {
    "black": lambda: {"type": "rectangle"} | grey(0),
    "white": lambda: {"type": "rectangle"} | grey(1),
    "front": lambda: {"type": "rectangle", "flip_normals": True} | grey(1),
    "lamp": lambda: {"type": "rectangle"} | grey(0) | emitting(1),
    "bright": lambda: {"type": "rectangle"} | grey(0) | emitting(2),
    "left": lambda: {"type": "point", "position": [0, 0, 1]},
    "right": lambda: {"type": "point", "position": [0, 0, 2]},
    "spot": lambda: {"type": "spot", "to_world": at(0, 0, 1)},
}


def scenes() -> list[mi.Scene]:
    """The same scene, its parts in another order and with other names each time."""
    orders = list(itertools.permutations(PARTS))[:: 40320 // 6]
    return [
        load({"type": "scene"} | {f"part{i}": PARTS[name]() for i, name in enumerate(order)})
        for order in orders
    ]


@pytest.mark.parametrize("ordered", [ordered_shapes, ordered_emitters])
def test_coincident_objects_are_told_apart(ordered):
    first, *others = ([content_digest(item) for item in ordered(scene)] for scene in scenes())
    assert len(set(first)) == len(first)
    assert all(other == first for other in others)


def test_the_fingerprint_does_not_depend_on_the_order():
    read = [SceneFingerprint()(scene) for scene in scenes()]
    assert len(set(read)) == 1


def test_what_boxes_tell_apart_is_not_read(monkeypatch):
    monkeypatch.setattr("envmap_integrator.system.scene_order.content_digest", None)
    assert len(ordered_shapes(load(room()))) == 4
