"""The fingerprint of a scene changes with what is prepared for it, and with nothing else."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from envmap_integrator.fingerprint import SceneFingerprint
from tests.helpers import at, camera, lamp, load, open_scene, room, scaled

pytestmark = pytest.mark.usefixtures("variant")

REFERENCE = {"group": {"type": "ref", "id": "group"}}


def textured_room(**changes) -> dict:
    """A room with a mesh, a bitmap, an instance and an environment."""
    image = mi.Bitmap(np.linspace(0, 1, 48, dtype=np.float32).reshape(4, 4, 3))
    texture = {"type": "bitmap", "bitmap": image, "raw": True}
    parts = {
        "block": {"type": "cube", "bsdf": {"type": "diffuse", "reflectance": texture}},
        "group": {"type": "shapegroup", "part": {"type": "sphere"}},
        "instance": {"type": "instance"} | REFERENCE,
        "sky": {"type": "envmap", "bitmap": mi.Bitmap(np.ones((4, 8, 3), np.float32))},
    }
    return room(**parts | changes)


def fingerprint(description: dict) -> str:
    return SceneFingerprint()(load(description))


@pytest.mark.parametrize("description", [room, textured_room, open_scene])
def test_two_loads_of_a_scene_agree(description):
    assert fingerprint(description()) == fingerprint(description())


@pytest.mark.parametrize(
    "changes",
    [
        lambda: {"sensor": camera(width=8, origin=(1, 1, 1))},
        lambda: {"second": camera()},
        lambda: {"integrator": {"type": "path"}},
    ],
)
def test_cameras_and_integrators_do_not_count(changes):
    assert fingerprint(textured_room(**changes())) == fingerprint(textured_room())


@pytest.mark.parametrize(
    "changes",
    [
        lambda: {"ball": None},
        lambda: {"ball": {"type": "sphere", "radius": 0.3}},
        lambda: {"lamp": lamp(z=1.8)},
        lambda: {"lamp": lamp(z=1.9, power=11)},
        lambda: {"lamp": lamp(z=1.9) | {"bsdf": {"type": "plastic"}}},
        lambda: {"block": {"type": "cube", "bsdf": {"type": "diffuse"}}},
        lambda: {"sky": {"type": "constant"}},
        lambda: {"instance": {"type": "instance", "to_world": at(0.1, 0, 0)} | REFERENCE},
        lambda: {"group": {"type": "shapegroup", "part": {"type": "sphere", "radius": 0.5}}},
    ],
)
def test_shapes_materials_and_emitters_count(changes):
    assert fingerprint(textured_room(**changes())) != fingerprint(textured_room())


@pytest.mark.parametrize(
    ("parameter", "change"),
    [
        ("ball.bsdf.reflectance.value", lambda value: value * 0.5),
        ("lamp.emitter.radiance.value", lambda value: value * 2),
        ("block.bsdf.reflectance.data", lambda value: value * 0.5),
        ("sky.data", lambda value: value + 1),
        ("sky.scale", lambda value: value * 2),
        ("ball.to_world", lambda value: mi.Transform4f(scaled(0.5)) @ value),
        ("lamp.emitter.sampling_weight", lambda value: value * 3),
    ],
)
def test_an_edit_counts_until_it_is_undone(parameter, change):
    scene = load(textured_room())
    read = SceneFingerprint()
    before = read(scene)
    assert read(scene) == before

    parameters = mi.traverse(scene)
    value = type(parameters[parameter])(parameters[parameter])
    parameters[parameter] = change(value)
    parameters.update()
    assert read(scene) != before

    parameters[parameter] = value
    parameters.update()
    assert read(scene) == before


def test_nothing_is_read_twice(monkeypatch):
    scene = load(textured_room())
    read = SceneFingerprint()
    before = read(scene)
    monkeypatch.setattr("envmap_integrator.fingerprint.hashlib", None)
    assert read(scene) == before


@pytest.mark.variants("llvm_ad_rgb", "llvm_ad_mono")
def test_each_variant_has_its_own(variant):
    read = fingerprint(room())
    other = "llvm_ad_mono" if variant == "llvm_ad_rgb" else "llvm_ad_rgb"
    mi.set_variant(other)
    assert fingerprint(room()) != read
