"""What an integrator or a file holds of one scene is never taken for what belongs to another."""

from __future__ import annotations

import gc
import weakref

import mitsuba as mi
import numpy as np
import pytest

from envmap_integrator.preparation.maps.interchange import write_cube
from tests.helpers import (
    at,
    ball,
    cluster,
    grey,
    integrator,
    lamp,
    load,
    open_scene,
    picture,
    room,
    scaled,
)

pytestmark = pytest.mark.usefixtures("variant")


def new_picture(scene: mi.Scene, kind: str = "one_level_path", **settings) -> np.ndarray:
    return picture(scene, integrator(kind, patches=256, **settings), spp=4)


def walls(**settings) -> dict:
    return {"walls": room()["walls"] | {"bsdf": {"type": "roughplastic"} | settings}}


# ---------------------- Scenes alike ----------------------


def flipped() -> dict:
    return {"lamp": lamp(z=1.9) | {"flip_normals": True}}


def directional() -> dict:
    emitter = lamp()["emitter"] | {"type": "directionalarea"}
    return {"lamp": lamp(z=1.9) | {"emitter": emitter}}


#: Changes of a scene that ``mi.traverse`` doesn't show, and what is said of them.
UNSEEN = {
    "flipped": (flipped, "other shapes"),
    "directional": (directional, "other emitters"),
    "nonlinear": (lambda: walls(nonlinear=True), "other materials"),
}


def alike(name: str) -> tuple[mi.Scene, mi.Scene]:
    """Two scenes that differ in what is unseen."""
    return load(room(**walls())), load(room(**walls() | UNSEEN[name][0]()))


@pytest.mark.parametrize("name", UNSEEN)
def test_a_state_of_a_scene_alike_is_refused(name, tmp_path):
    one, other = alike(name)
    path = tmp_path / "state.exr"
    integrator("one_level_path", patches=256).prepare(one).save(path)
    reader = integrator("one_level_path", patches=256, cache_file=str(path))
    reader.prepare(one)
    with pytest.raises(ValueError, match=f"another scene: it has {UNSEEN[name][1]}; make it again"):
        reader.prepare(other)


@pytest.mark.parametrize("name", UNSEEN)
def test_an_integrator_tells_scenes_alike_apart(name):
    one, other = alike(name)
    renderer = integrator("one_level_path", patches=256)
    for scene in (one, other, one):
        assert np.array_equal(picture(scene, renderer, spp=4), new_picture(scene))


@pytest.mark.parametrize("change", ["to_world", "scale"])
def test_a_turned_or_brighter_sky_is_another(change, tmp_path):
    changes = {"to_world": mi.ScalarTransform4f().rotate([0, 0, 1], 90), "scale": 2.0}
    write_cube(tmp_path / "sky.exr", [np.random.default_rng(4).random((24, 4, 3))])
    sky = {"type": "mipmap_cube", "filename": str(tmp_path / "sky.exr")}
    renderer = integrator("one_level_path", patches=256)
    one, other = (load(open_scene(sky=sky | more)) for more in ({}, {change: changes[change]}))
    assert renderer.prepare(one).key != renderer.prepare(other).key
    assert renderer.prepare(load(open_scene(sky=sky))).key == renderer.prepare(one).key


# ---------------------- Scenes that share ----------------------


def test_scenes_may_share_shapes_and_emitters():
    shared = {
        name: mi.load_dict(part)
        for name, part in room().items()
        if name in ("walls", "ball", "lamp")
    }
    spot = {"type": "spot", "to_world": at(0, 0, 1)}
    descriptions = [
        room(**shared),
        room(**shared, point={"type": "point", "position": [1, 1, 1]}, spot=spot),
        room(**shared, block=None),
        room(**shared, other=ball(-1, -1, -1, 0.3)),
    ]
    renderer = integrator("one_level_path", patches=256)
    for description in descriptions:
        scene = load(description)
        assert np.array_equal(picture(scene, renderer, spp=4), new_picture(scene))


def test_scenes_may_come_and_go():
    """What is freed leaves its address to what comes next."""
    renderer = integrator("envmap_hybrid", patches=256, desk=cluster("ball"), map_resolution=4)
    for z in (-1.6, 0.0, 1.0, -1.6):
        scene = load(room(ball=ball(0.4, 0.2, z, 0.4)))
        other = integrator("envmap_hybrid", patches=256, desk=cluster("ball"), map_resolution=4)
        assert np.array_equal(picture(scene, renderer, spp=4), picture(scene, other, spp=4))
        del scene
        gc.collect()


def test_a_scene_goes_with_its_integrator():
    """An integrator that held its scene would keep both for ever."""
    renderer = integrator("one_level_path", patches=256)
    gone = weakref.ref(renderer)
    scene = load(room(integrator=renderer))
    mi.render(scene, spp=1)
    del renderer, scene
    gc.collect()
    assert gone() is None


# ---------------------- Shapes that move ----------------------


def placed_groups() -> dict:
    """Two instances of two groups."""
    parts = {}
    for name, x in (("one", -1.0), ("two", 1.0)):
        parts[f"group_{name}"] = {
            "type": "shapegroup",
            "part": ball(0, 0, 0, 0.3) | grey(0.2 + x / 8),
        }
        parts[name] = {
            "type": "instance",
            "to_world": at(x, 0, 0),
            "of": {"type": "ref", "id": f"group_{name}"},
        }
    return room(**parts)


def two_disks() -> dict:
    disk = {"type": "disk", "to_world": at(0.6, -0.4, 0) @ scaled(0.3)} | grey(0.8)
    return room(disk=disk, other=disk | {"to_world": at(0.6, -0.4, -1) @ scaled(0.3)} | grey(0.1))


#: Scenes and what is done to them: parameter → transform.
MOVES = {
    "past others": (two_disks, lambda: {"disk.to_world": at(-1.5, -1.5, 0.3) @ scaled(0.5)}),
    "in each other's place": (
        two_disks,
        lambda: {
            "disk.to_world": at(0.6, -0.4, -1) @ scaled(0.3),
            "other.to_world": at(0.6, -0.4, 0) @ scaled(0.3),
        },
    ),
    "onto each other": (two_disks, lambda: {"disk.to_world": at(0.6, -0.4, -1) @ scaled(0.3)}),
    "instance": (placed_groups, lambda: {"two.to_world": at(-1.6, -1.5, 0)}),
    "instances exchanged": (
        placed_groups,
        lambda: {"one.to_world": at(1, 0, 0), "two.to_world": at(-1, 0, 0)},
    ),
    "lamp": (
        lambda: room(second=lamp(-1, 0, 1.8, 0.2)),
        lambda: {"second.to_world": lamp(1.5, 0, 1.95, 0.3)["to_world"]},
    ),
}


@pytest.mark.parametrize("name", MOVES)
@pytest.mark.parametrize("kind", ["one_level_path", "envmap_hybrid"])
def test_shapes_may_move(name, kind):
    describe, places = MOVES[name]
    scene, renderer = load(describe()), integrator(kind, patches=256, **OF_KIND[kind])
    before = picture(scene, renderer, spp=4)
    parameters = mi.traverse(scene)
    for key, place in places().items():
        parameters[key] = mi.Transform4f(place.matrix)
    parameters.update()
    after = picture(scene, renderer, spp=4)
    assert not np.array_equal(before, after)
    assert np.array_equal(after, new_picture(scene, kind, **OF_KIND[kind]))


# ---------------------- Settings that change ----------------------

OF_KIND = {"one_level_path": {}, "envmap_hybrid": {"map_resolution": 4}}


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("mip_bias", 1.5),
        ("lookup", "plain"),
        ("mirrors", "map"),
        ("map_resolution", 8),
        ("secondary_samples", 2),
        ("shadow_samples", 1),
        ("second_hit", "shadow_rays"),
        ("gather_depth", 2),
        ("patches", 512),
    ],
)
def test_attributes_may_change(name, value):
    scene = load(room())
    settings = {"patches": 256, "map_resolution": 4}
    renderer = integrator("envmap_hybrid", **settings)
    picture(scene, renderer, spp=4)
    setattr(renderer, name, value)
    new = integrator("envmap_hybrid", **settings | {name: value})
    assert np.array_equal(picture(scene, renderer, spp=4), picture(scene, new, spp=4))


def test_the_cache_file_may_change(tmp_path):
    scene, path = load(room()), tmp_path / "state.exr"
    baked = integrator("one_level_path").prepare(scene, spp=4)
    renderer = integrator("one_level_path")
    own = renderer.prepare(scene, spp=4)
    baked.save(path)
    renderer.cache_file = str(path)
    assert renderer.prepare(scene, spp=4) is not own
    renderer.cache_file = str(tmp_path / "none.exr")
    with pytest.raises(ValueError, match="no such file"):
        renderer.prepare(scene, spp=4)
