"""White furnaces: closed scenes in which the radiance is known, or the same from everywhere."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from tests.helpers import (
    assert_agree,
    ball,
    block,
    camera,
    cluster,
    emitting,
    exactly,
    film,
    grey,
    integrator,
    load,
    measure,
    scaled,
)

pytestmark = pytest.mark.usefixtures("variant")

LISTED = "envmap_hybrid-listed"
ALGORITHMS = ("source_selection", "one_level_path", "envmap_hybrid", LISTED)
#: The error of the cache is the same in every seed: enough samples make it small.
SETTINGS = {"patches": 4096, "patch_samples": 1024, "shadow_samples": 16}


def algorithm(name: str, *shapes: str, **settings) -> mi.Integrator:
    """An integrator, without clusters of ours, or with one of the given shapes."""
    if name == LISTED:
        desk, baker = cluster(*shapes), {"type": "envmap_bake", "samples": 64}
        return integrator("envmap_hybrid", desk=desk, baker=baker, **SETTINGS | settings)
    return integrator(name, **SETTINGS | settings)


def dressed(shape: dict, albedo: float, emission: float) -> dict:
    return shape | grey(albedo) | (emitting(emission) if emission else {})


def furnace(albedo: float, walls_shine: bool, contents_shine: bool) -> mi.Scene:
    """A hollow ball around a block and a ball, in which the radiance is one everywhere.

    What shines has the albedo and emits what it absorbs; what doesn't is white.
    """

    def finish(shape, shines):
        return dressed(shape, *((albedo, 1 - albedo) if shines else (1, 0)))

    return load(
        {
            "type": "scene",
            "sensor": camera(32, 24, origin=(0, -1.6, 0.2), target=(0, 0.3, 0)),
            "walls": finish(ball(0, 0, 0, 2) | {"flip_normals": True}, walls_shine),
            "block": finish(block(-0.5, 0.3, -0.2, 0.35), contents_shine),
            "ball": finish(ball(0.5, 0.2, -0.1, 0.4), contents_shine),
        }
    )


@pytest.mark.parametrize("name", ALGORITHMS)
@pytest.mark.parametrize(
    ("albedo", "walls_shine", "contents_shine"),
    [
        pytest.param(0.2, True, True, id="0.2"),
        pytest.param(0.5, True, True, id="0.5"),
        pytest.param(0.8, True, True, id="0.8"),
        pytest.param(0.5, True, False, id="sources-outside-the-cube"),
        pytest.param(0.5, False, True, id="sources-inside-the-cube"),
    ],
)
def test_radiance_is_right_everywhere(name, albedo, walls_shine, contents_shine):
    scene = furnace(albedo, walls_shine, contents_shine)
    ours = measure(scene, algorithm(name))
    assert_agree(ours.tiles(8), exactly(1), allowed=0.005, precision=0.0075)


# ---------------------- Materials ----------------------

MATERIALS = (
    "diffuse plastic roughplastic conductor roughconductor very-roughconductor dielectric "
    "roughdielectric thindielectric principled principled-glass blendbsdf mask twosided normalmap "
    "bumpmap"
).split()


def texture(values) -> dict:
    bitmap = mi.Bitmap(np.asarray(values, dtype=np.float32))
    return {"type": "bitmap", "bitmap": bitmap, "raw": True, "filter_type": "bilinear"}


def ripples() -> np.ndarray:
    x = np.linspace(0, 12 * np.pi, 64, endpoint=False)
    return 0.05 * np.sin(x)[:, None] * np.sin(x)[None, :]


def tilted_normals() -> np.ndarray:
    slope = 6 * ripples()
    normals = np.stack([slope, slope.T, np.ones_like(slope)], axis=-1)
    return 0.5 + 0.5 * normals / np.linalg.norm(normals, axis=-1, keepdims=True)


def materials() -> list[dict]:
    diffuse = grey(0.6)["bsdf"]
    metal = {"type": "conductor", "specular_reflectance": {"type": "rgb", "value": 0.8}}
    by_name = {
        "diffuse": diffuse,
        "plastic": {"type": "plastic", "diffuse_reflectance": {"type": "rgb", "value": 0.6}},
        "roughplastic": {"type": "roughplastic", "alpha": 0.2},
        "conductor": metal,
        "roughconductor": {"type": "roughconductor", "material": "Cu", "alpha": 0.1},
        "very-roughconductor": {"type": "roughconductor", "material": "Cu", "alpha": 0.6},
        "dielectric": {"type": "dielectric"},
        "roughdielectric": {"type": "roughdielectric", "alpha": 0.2},
        "thindielectric": {"type": "thindielectric"},
        "principled": {"type": "principled", "metallic": 0.4, "roughness": 0.3, "clearcoat": 0.5},
        "principled-glass": {"type": "principled", "spec_trans": 0.7, "roughness": 0.3},
        "blendbsdf": {"type": "blendbsdf", "weight": 0.3, "a": diffuse, "b": metal},
        "mask": {"type": "mask", "opacity": 0.4, "bsdf": diffuse},
        "twosided": {"type": "twosided", "bsdf": {"type": "roughplastic", "alpha": 0.1}},
        "normalmap": {"type": "normalmap", "normalmap": texture(tilted_normals()), "bsdf": diffuse},
        "bumpmap": {"type": "bumpmap", "map": texture(ripples()), "bsdf": diffuse},
    }
    return [by_name[name] for name in MATERIALS]


def show_case() -> mi.Scene:
    """A ball of each material in a shining hollow one, one to a tile of 8 x 8 pixels."""
    balls = {
        name: ball(i % 4 - 1.5, 1.5 - i // 4, 0, 0.45) | {"bsdf": material}
        for i, (name, material) in enumerate(zip(MATERIALS, materials(), strict=True))
    }
    orthographic = camera() | {
        "type": "orthographic",
        "to_world": mi.ScalarTransform4f().look_at([0, 0, 2.5], [0, 0, 0], [0, 1, 0]) @ scaled(2),
        "film": film(32, 32),
    }
    del orthographic["fov"], orthographic["near_clip"]
    walls = ball(0, 0, 0, 4) | {"flip_normals": True}
    return load(
        {"type": "scene", "sensor": orthographic, "walls": dressed(walls, 0.5, 0.5)} | balls
    )


@pytest.fixture(scope="module")
def scene(variant):
    return show_case()


@pytest.fixture(scope="module")
def path(scene):
    return measure(scene, integrator("path"), spp=256).tiles(8)


@pytest.fixture(scope="module", params=ALGORITHMS)
def ours(request, scene):
    settings = {"patches": 2048, "patch_samples": 256}
    return measure(scene, algorithm(request.param, *MATERIALS, **settings)).tiles(8)


@pytest.mark.parametrize("material", MATERIALS)
def test_energy_of_materials(ours, path, material):
    tile = divmod(MATERIALS.index(material), 4)
    assert_agree(ours.at(tile), path.at(tile), allowed=0.01, precision=0.02)
