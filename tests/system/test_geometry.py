"""Scenes that are hard on geometry or numbers: finite, not negative, and as bright as with path."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from tests.helpers import (
    assert_agree,
    at,
    ball,
    block,
    box,
    camera,
    cluster,
    emitting,
    film,
    grey,
    integrator,
    lamp,
    load,
    measure,
    open_scene,
    picture,
    room,
    scaled,
)

pytestmark = pytest.mark.usefixtures("variant")

SKY = {"type": "constant", "radiance": 1.0}


def glass(bsdf: str, **settings) -> dict:
    return {"bsdf": {"type": bsdf} | settings}


def placed(scale: float = 1.0, offset=(0.0, 0.0, 0.0)) -> dict:
    """A room whose parts are meshes, scaled and moved together with its camera."""
    transform = at(*offset) @ scaled(scale)
    scene = room(ball=block(0.4, 0.2, -1.6, 0.3) | grey(0.6, 0.3, 0.2))
    for name in ("walls", "lamp", "block", "ball"):
        scene[name] = scene[name] | {"to_world": transform @ scene[name]["to_world"]}
    origin, target = (scale * np.array(p) + offset for p in ((0, -1.8, 0.4), (0, 0.5, -1)))
    return scene | {"sensor": camera(origin=origin.tolist(), target=target.tolist())}


def instances() -> dict:
    group = {
        "type": "shapegroup",
        "ball": ball(0, 0, 0, 0.2) | grey(0.7),
        "block": block(0, 0, 0.35, 0.15) | grey(0.3),
    }
    copies = {
        f"copy{i}": {
            "type": "instance",
            "to_world": at(i - 1, 0.3 * i, -1.7),
            "group": {"type": "ref", "id": "group"},
        }
        for i in range(3)
    }
    return room(group=group, ball=None, block=None) | copies


def analytic_shapes() -> dict:
    cylinder = {"type": "cylinder", "p0": [0.4, 0.2, -2], "p1": [0.4, 0.2, -1.4], "radius": 0.3}
    disk = {"type": "disk", "to_world": at(0.4, 0.2, -1.4) @ scaled(0.3)}
    return room(ball=cylinder | grey(0.6), lid=disk | grey(0.4))


def triangle() -> dict:
    """One triangle under the open sky."""
    mesh = mi.Mesh("triangle", 3, 1)
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = np.array([-1, 0, -1, 1, 0, -1, 0, 0.5, 1], np.float32)
    parameters["faces"] = np.array([0, 1, 2], np.uint32)
    parameters.update()
    return {"type": "scene", "sensor": camera(target=(0, 0, 0)), "sky": SKY, "triangle": mesh}


def see_through() -> dict:
    leaf = {"type": "rectangle", "to_world": at(0.4, -0.4, -1.2) @ scaled(0.4)}
    half = {"type": "mask", "opacity": 0.5, "bsdf": {"type": "twosided"} | grey(0.6)}
    return room(leaf=leaf | {"bsdf": half}, pane=ball(-0.2, -0.6, -1.6, 0.2) | glass("null"))


#: Scenes, and the clusters that the integrator is given (none: it finds its own).
CASES = {
    "camera-in-the-cube": (lambda: room(sensor=camera(origin=(0, -0.6, -1))), {"a": cluster()}),
    "surface-on-the-cube's-faces": (
        lambda: room(ball=None, shelf=box(0.4) | {"to_world": at(-0.5, 0.6, -1.5)} | grey(0.4)),
        {"a": cluster("block", distance_ratio=1.0)},
    ),
    "object-straddles-the-cube": (
        lambda: room(bar=block(0, 0.5, -1, 1) | grey(0.3) | {"to_world": bar()}),
        {"a": cluster()},
    ),
    "overlapping-clusters": (
        room,
        {"a": cluster("block", distance_ratio=2.0), "b": cluster("ball", distance_ratio=3.0)},
    ),
    "nested-clusters": (
        room,
        {"a": cluster("block", distance_ratio=1.2), "b": cluster("ball", distance_ratio=4.0)},
    ),
    "walls-as-a-cluster": (room, {"a": cluster("walls", distance_ratio=1.0)}),
    "instances": (instances, {"a": cluster("copy0", "copy1")}),
    "analytic-shapes": (analytic_shapes, {"a": cluster("ball", "lid")}),
    "mask-and-null": (see_through, {"a": cluster("block", "ball", "leaf")}),
    "dielectric": (
        lambda: open_scene(sky=SKY, ball=ball(0.4, 0.2, -1.5, 0.4) | glass("dielectric")),
        {"a": cluster()},
    ),
    "tiny": (lambda: placed(1e-4), {"a": cluster()}),
    "huge": (lambda: placed(1e5), {"a": cluster()}),
    "far-from-the-origin": (lambda: placed(offset=(3000, -2000, 1000)), {"a": cluster()}),
    "single-triangle": (triangle, {}),
    "great-and-small-radiance": (
        lambda: room(lamp=lamp(z=1.9, power=1e8), ball=dim_ball()),
        {"a": cluster()},
    ),
    "black-and-white": (
        lambda: room(
            block=block(-0.5, 0.6, -1.5, 0.4) | grey(1), ball=ball(0.6, 0, -1.4, 0.4) | grey(0)
        ),
        {},
    ),
}


def bar():
    return at(0, 0.5, -0.9) @ mi.ScalarTransform4f().scale([1.9, 0.1, 0.1])


def dim_ball() -> dict:
    return ball(0.4, 0.2, -1.6, 0.4) | grey(0.5) | emitting(1e-8)


@pytest.mark.parametrize("case", CASES)
def test_case(case):
    make, clusters = CASES[case]
    scene = load(make())
    ours = measure(scene, integrator("envmap_hybrid", **clusters), spp=128).overall()
    path = measure(scene, integrator("path"), spp=256).overall()
    assert_agree(ours, path, allowed=0.02, precision=0.03)


# ---------------------- Films and sensors ----------------------


@pytest.fixture(scope="module")
def hybrid(variant):
    return integrator("envmap_hybrid", desk=cluster())


@pytest.fixture(scope="module")
def whole(hybrid):
    return measure(load(room()), hybrid, spp=128)


def test_film_of_one_pixel(hybrid, whole):
    one = measure(load(room(sensor=camera(1, 1))), hybrid, spp=8192)
    square = whole.mean[:, 4:28].mean()  # the field of view is that of the width
    assert one.mean.item() == pytest.approx(square, rel=0.5)
    assert picture(load(room(sensor=camera(1, 1))), hybrid, spp=1).shape == (1, 1, 3)


def test_crop_window(hybrid, whole):
    crop = {"crop_offset_x": 8, "crop_offset_y": 4, "crop_width": 16, "crop_height": 12}
    scene = load(room(sensor=camera() | {"film": film(32, 24, **crop)}))
    ours = measure(scene, hybrid, spp=128)
    assert ours.mean.shape == (12, 16)
    window = type(whole)(whole.mean[4:16, 8:24], whole.variance[4:16, 8:24])
    assert_agree(ours.tiles(4), window.tiles(4), precision=0.1)


@pytest.mark.parametrize("spp", [1, 3, 100])
def test_any_number_of_samples(hybrid, whole, spp):
    seeds = 4 if spp > 3 else 64
    ours = measure(load(room()), hybrid, spp, seeds).overall()
    assert_agree(ours, whole.overall(), allowed=0.005, precision=0.05)


def test_several_sensors_agree(hybrid, whole):
    scene = load(room(second=camera()))
    assert np.array_equal(picture(scene, hybrid, sensor=0), picture(scene, hybrid, sensor=1))


def test_several_secondary_samples(whole):
    several = integrator("envmap_hybrid", desk=cluster(), secondary_samples=4, shadow_samples=4)
    assert_agree(measure(load(room()), several).overall(), whole.overall(), allowed=0.01)


def test_inside_the_aov_integrator(hybrid):
    scene = load(room())
    aov = mi.load_dict({"type": "aov", "aovs": "depth:depth", "hybrid": hybrid})
    pixels = np.array(mi.render(scene, integrator=aov, spp=4))
    assert pixels.shape == (24, 32, 4)
    assert np.isfinite(pixels).all() and pixels[..., 3].min() > 0
    assert pixels[..., :3].mean() == pytest.approx(picture(scene, hybrid, spp=4).mean(), rel=0.1)


def test_alpha():
    scene = open_scene(floor=None, sky=SKY)
    scene["sensor"]["film"]["pixel_format"] = "rgba"
    hidden = integrator("envmap_hybrid", hide_emitters=True)
    ours, path = (
        picture(load(scene), renderer, spp=64)[..., 3]
        for renderer in (hidden, integrator("path", hide_emitters=True))
    )
    assert np.abs(ours - path).max() < 0.3 and ours.mean() == pytest.approx(path.mean(), abs=0.01)
