"""The fingerprint of a scene changes with what is prepared for it, and with nothing else."""

from __future__ import annotations

import subprocess
import sys

import mitsuba as mi
import numpy as np
import pytest

from envmap_integrator.system.fingerprint import PARTS, SceneFingerprint, difference
from tests.helpers import ROOT, at, ball, camera, lamp, load, open_scene, room, scaled

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


def noise(**settings) -> dict:
    image = mi.Bitmap(np.random.default_rng(1).random((8, 8, 3), np.float32))
    return {"type": "bitmap", "bitmap": image, "raw": True} | settings


def material(kind: str, **settings) -> dict:
    return {"ball": ball(0, 0, 0, 0.3) | {"bsdf": {"type": kind} | settings}}


def mapped(kind: str, **settings) -> dict:
    """A material with a bump or normal map."""
    name = "normalmap" if kind == "normalmap" else "texture"
    return material(kind, nested={"type": "diffuse"}, **{name: noise()}, **settings)


def painted(**settings) -> dict:
    return material("diffuse", reflectance=noise(**settings))


def filled(**settings) -> dict:
    grid = np.random.default_rng(1).random((4, 4, 4, 1), np.float32)
    volume = {"type": "gridvolume", "grid": mi.VolumeGrid(grid)} | settings
    return material("diffuse", reflectance={"type": "volume", "volume": volume})


def level_set(**settings) -> dict:
    place = np.indices((8, 8, 8)) - np.array([3.5, 3.2, 3.5])[:, None, None, None]
    grid = (np.linalg.norm(place, axis=0) - 2)[..., None] / 8
    return {"ball": {"type": "sdfgrid", "grid": mi.TensorXf(grid.astype(np.float32))} | settings}


def groups(of_instance="group", **settings) -> dict:
    """Two groups of a sphere each, and an instance of one of them."""
    return {
        "group": {"type": "shapegroup", "part": ball(0, 0, 0, 0.1) | settings},
        "other": {"type": "shapegroup", "part": ball(0, 0, 0, 0.1) | {"bsdf": {"type": "plastic"}}},
        "instance": {"type": "instance", "of": {"type": "ref", "id": of_instance}},
    }


def lit(kind: str, **settings) -> dict:
    return {"lamp": lamp(z=1.9) | {"emitter": {"type": kind, "radiance": noise(**settings)}}}


def projector(fov=40.0, **settings) -> dict:
    return {"sky": {"type": "projector", "irradiance": noise(**settings), "fov": fov}}


def sunny(**settings) -> dict:
    return {"sky": {"type": "sunsky", "sun_direction": [0, 0.5, 1]} | settings}


FLIPPED = {"flip_normals": True}
BLOCK = {"block": {"type": "cube"}}


def two_materials(of_block: str, of_ball: str) -> dict:
    return {
        "block": {"type": "cube", "bsdf": {"type": of_block}},
        "ball": {"type": "sphere", "bsdf": {"type": of_ball}},
    }


#: Pairs of scenes that ``mi.traverse`` shows alike, or nearly, and in what they differ.
HIDDEN = {
    "front of a ball": (
        lambda: {"ball": ball(0, 0, 0, 0.3)},
        lambda: {"ball": ball(0, 0, 0, 0.3) | FLIPPED},
        "shapes",
    ),
    "front of a lamp": (lambda: {}, lambda: {"lamp": lamp(z=1.9) | FLIPPED}, "shapes"),
    "front in a group": (groups, lambda: groups(**FLIPPED), "shapes"),
    "material in a group": (groups, lambda: groups(bsdf={"type": "plastic"}), "materials"),
    "group": (groups, lambda: groups("other"), "shapes"),
    "flat faces": (
        lambda: BLOCK,
        lambda: {"block": BLOCK["block"] | {"face_normals": True}},
        "shapes",
    ),
    "normals": (level_set, lambda: level_set(normals="analytic"), "shapes"),
    "wrap": (painted, lambda: painted(wrap_mode="clamp"), "materials"),
    "wrap mirror": (painted, lambda: painted(wrap_mode="mirror"), "materials"),
    "filter": (painted, lambda: painted(filter_type="nearest"), "materials"),
    "wrap in space": (filled, lambda: filled(wrap_mode="repeat"), "materials"),
    "filter in space": (filled, lambda: filled(filter_type="nearest"), "materials"),
    "nonlinear": (
        lambda: material("plastic"),
        lambda: material("plastic", nonlinear=True),
        "materials",
    ),
    "nested nonlinear": (
        lambda: material("mask", nested={"type": "roughplastic"}),
        lambda: material("mask", nested={"type": "roughplastic", "nonlinear": True}),
        "materials",
    ),
    "distribution": (
        lambda: material("roughconductor"),
        lambda: material("roughconductor", distribution="ggx"),
        "materials",
    ),
    "two sides": (
        lambda: material("diffuse"),
        lambda: material("twosided", nested={"type": "diffuse"}),
        "materials",
    ),
    "normal map, flips": (
        lambda: mapped("normalmap"),
        lambda: mapped("normalmap", flip_invalid_normals=False),
        "materials",
    ),
    "normal map, shadows": (
        lambda: mapped("normalmap"),
        lambda: mapped("normalmap", use_shadowing_function=False),
        "materials",
    ),
    "bump map, flips": (
        lambda: mapped("bumpmap"),
        lambda: mapped("bumpmap", flip_invalid_normals=False),
        "materials",
    ),
    "bump map, shadows": (
        lambda: mapped("bumpmap"),
        lambda: mapped("bumpmap", use_shadowing_function=False),
        "materials",
    ),
    "directional": (lambda: lit("area"), lambda: lit("directionalarea"), "emitters"),
    "filter of a lamp": (
        lambda: lit("area"),
        lambda: lit("area", filter_type="nearest"),
        "emitters",
    ),
    "field of view": (projector, lambda: projector(fov=40.1), "emitters"),
    "wrap of a slide": (projector, lambda: projector(wrap_mode="clamp"), "emitters"),
    "sun": (sunny, lambda: sunny(complex_sun=True), "emitters"),
    "materials exchanged": (
        lambda: two_materials("diffuse", "plastic"),
        lambda: two_materials("plastic", "diffuse"),
        PARTS[-1],
    ),
}


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
        ("block.bsdf.reflectance.to_uv", lambda value: type(value)().scale([1, 1 + 1e-6])),
        ("group.part.to_world", lambda value: mi.Transform4f(scaled(0.5)) @ value),
        ("group.part.bsdf.reflectance.value", lambda value: value * 0.5),
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


@pytest.mark.parametrize("name", HIDDEN)
def test_what_parameters_hide_counts(name):
    one, other, part = HIDDEN[name]
    before, after = fingerprint(room(**one())), fingerprint(room(**other()))
    assert fingerprint(room(**one())) == before
    assert difference(before, after) == part


UNNAMED = """<scene version="3.0.0"> <shape type="shapegroup" id="group"> {parts} </shape>
<shape type="instance"> <ref id="group"/> </shape> <emitter type="constant"/> </scene>"""
PART = """<shape type="sphere"> <bsdf type="diffuse">
<float name="reflectance" value="{}"/> </bsdf> </shape>"""


def test_all_shapes_of_a_group_count():
    """Those without a name have the same one."""

    def read(*greys):
        scene = mi.load_string(UNNAMED.format(parts=" ".join(map(PART.format, greys))))
        return SceneFingerprint()(scene)

    assert read(0.1, 0.2, 0.3) == read(0.3, 0.1, 0.2)
    assert len({read(0.1, 0.2, 0.3), read(0.4, 0.2, 0.3), read(0.1, 0.4, 0.3), read(0.2, 0.3)}) == 4


def test_little_numbers_count():
    moved = {"ball": ball(0.4, 0.2, -1.6, 0.4 + 1e-7)}
    assert fingerprint(room(**moved)) != fingerprint(room(ball=ball(0.4, 0.2, -1.6, 0.4)))


def test_nothing_is_read_twice(monkeypatch):
    scene = load(textured_room())
    read = SceneFingerprint()
    before = read(scene)
    monkeypatch.setattr("envmap_integrator.system.fingerprint.blake3", None)
    assert read(scene) == before


def all_hidden() -> dict:
    """A scene of objects that are told apart by what they do."""
    parts = {}
    for index, (_, make, _) in enumerate(HIDDEN.values()):
        for name, part in make().items():
            if name in ("ball", "lamp", "sky"):
                parts[f"{name}{index}"] = part
    return room(**parts)


PRINT = """
import envmap_integrator
import drjit as dr
import mitsuba as mi
mi.set_variant("llvm_ad_rgb")
from tests.unit.test_fingerprint import all_hidden, fingerprint
dr.set_thread_count(1)
print(fingerprint(all_hidden()))
"""


def test_another_process_with_other_threads_agrees():
    command = [sys.executable, "-c", PRINT]
    result = subprocess.run(command, check=True, cwd=ROOT, capture_output=True, text=True)
    assert result.stdout.split()[-1] == fingerprint(all_hidden())


def coat(**attributes) -> mi.BSDF:
    """A material as users write them: it shows no parameters, and prints nothing."""

    class Coat(mi.BSDF):
        def __init__(self, props):
            super().__init__(props)
            self.m_components = [mi.BSDFFlags.DiffuseReflection | mi.BSDFFlags.FrontSide]
            self.m_flags = self.m_components[0]
            vars(self).update(attributes)

        def eval(self, context, si, wo, active=True):
            return mi.Spectrum(getattr(self, "function", lambda wo: 0.5)(wo))

    return Coat(mi.Properties())


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ({"level": 1.0}, {"level": 2.0}),
        ({"levels": [1, 2]}, {"levels": [1, 3]}),
        ({"function": lambda wo: 0.5}, {"function": lambda wo: 0.5 + wo.x}),
        ({"nested": lambda: {"type": "diffuse"}}, {"nested": lambda: {"type": "plastic"}}),
        ({"values": lambda: [1.0, 2.0]}, {"values": lambda: [1.0, 3.0]}),
        ({"table": np.zeros(3)}, {"table": np.ones(3)}),
        ({"function": lambda wo: 0.5}, {"function": lambda wo: 0.25}),
    ],
)
def test_plugins_in_python_count(one, other):
    def read(attributes):
        attributes = dict(attributes)
        if "nested" in attributes:
            attributes["nested"] = mi.load_dict(attributes["nested"]())
        if "values" in attributes:
            attributes["values"] = mi.Float(attributes["values"]())
        return fingerprint(room(ball=ball(0, 0, 0, 0.3) | {"bsdf": coat(**attributes)}))

    assert read(one) == read(one)
    assert read(one) != read(other)


@pytest.mark.variants("llvm_ad_rgb", "llvm_ad_mono")
def test_each_variant_has_its_own(variant):
    read = fingerprint(room())
    other = "llvm_ad_mono" if variant == "llvm_ad_rgb" else "llvm_ad_rgb"
    mi.set_variant(other)
    assert fingerprint(room()) != read
