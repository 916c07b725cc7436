"""Random scenes, and what each integrator has to make of them.

A *recipe* is plain JSON, so that a scene that fails can be rendered again. It also says what has
come before: another scene, another view, another place of a shape. A scene passes if it gives a
picture that is finite, not negative, no brighter than physics allows and as bright as ``path``'s,
or, where something has been put wrong into it, the documented error.

``python -m tests.fuzz.scenes --count 2000`` goes through many, in processes of their own, so that
one that crashes or hangs is known by its recipe too; ``--repeat RECIPE.json`` renders one again.
"""

from __future__ import annotations

import argparse
import json
import math
import subprocess
import sys
import tempfile
import traceback
from dataclasses import dataclass
from pathlib import Path
from random import Random
from typing import Any

import mitsuba as mi
import numpy as np
from hypothesis import HealthCheck, Phase, given, seed, settings
from hypothesis import strategies as st

from compare.scene_kit import BLACK_SKY
from envmap_integrator.cli.errors import condense
from tests.fuzz.history import earlier_scene, first_frame, move
from tests.fuzz.rooms import THICK, room_parts
from tests.helpers import at, film, grey, scaled

Recipe = dict[str, Any]

#: Relative error of the picture's mean that an integrator may leave for its method.
BIAS = {"envmap_hybrid": 0.05, "one_level_path": 0.05, "source_selection": 0.2}
#: Half width of the interval for the means' difference, in standard errors.
SIGMAS = 6
#: And the part of it, in the standard errors that the cache states of itself: where light is rare.
STATED = 4
#: Materials that let light straight through.
SEE_THROUGH = ("mask", "null", "thindielectric")
#: Films are small: what is fuzzed is scenes.
SIZE = 8
#: Seconds after which a scene counts as hanging; compilation takes a few.
HANGS_AFTER = 300
#: Mitsuba starts rays 1e-4 off surfaces, also where that is as large as the scene: pictures of
#: smaller scenes than this, those of ``path`` too, aren't those of the scene.
TINIEST = 1e-3
#: Walls no brighter than this let the light of a closed scene die out soon.
WHITEST_WALL = 0.9

# ---------------------- Recipes ----------------------


def reals(low: float, high: float):
    """Numbers of few digits; borders more often than by chance."""
    numbers = st.floats(low, high).map(lambda number: round(number, 4))
    return st.one_of(numbers, numbers, st.sampled_from([low, high]))


def logarithmic(low: float, high: float):
    return st.floats(math.log(low), math.log(high)).map(lambda x: float(f"{math.exp(x):.4g}"))


def points(reach: float):
    return st.tuples(*[reals(-reach, reach)] * 3).map(list)


def colours(high: float = 1.0):
    return st.one_of(reals(0.0, high), st.tuples(*[reals(0.0, high)] * 3).map(list))


ROUGHNESS = logarithmic(0.001, 1.0)
ALPHA = {"distribution": st.sampled_from(["ggx", "beckmann"]), "alpha": ROUGHNESS}

#: Parameters of materials; nested ones are drawn in ``materials``.
MATERIALS: dict[str, dict] = {
    "diffuse": {"reflectance": colours()},
    "conductor": {"material": st.sampled_from(["Au", "Cu", "none"])},
    "roughconductor": {"material": st.sampled_from(["Al", "none"])} | ALPHA,
    "dielectric": {"int_ior": reals(1.0, 2.5)},
    "thindielectric": {"int_ior": reals(1.0, 2.5)},
    "roughdielectric": {"int_ior": reals(1.1, 2.5)} | ALPHA,
    "plastic": {"diffuse_reflectance": colours(), "nonlinear": st.booleans()},
    "roughplastic": {"diffuse_reflectance": colours()} | ALPHA,
    "principled": {
        "base_color": colours(),
        "roughness": ROUGHNESS,
        "metallic": reals(0.0, 1.0),
        "specular": reals(0.0, 1.0),
        "clearcoat": reals(0.0, 1.0),
        "sheen": reals(0.0, 1.0),
        "spec_trans": reals(0.0, 1.0),
    },
    "null": {},
}
#: Half of all palettes have rough metal.
METALS = ("roughconductor", "principled", "plastic", "roughconductor")
ONE_SIDED = ("diffuse", "conductor", "roughconductor", "plastic", "roughplastic")
WRAPPERS = ("twosided", "mask", "blendbsdf", "bumpmap", "normalmap", "textured")
#: Shapes that Mitsuba can't sample as sources.
NO_SOURCES = ("curve", "sdfgrid")
SHAPES = ("cube", "sphere", "rectangle", "disk", "cylinder", "triangles", "curve", "sdfgrid")


LIGHTS = ("point", "spot", "directional", "constant", "envmap", "sunsky", "area")
FROM_OUTSIDE = ("directional", "constant", "envmap", "sunsky")
SENSORS = ("perspective", "perspective", "thinlens", "orthographic")


@dataclass(frozen=True)
class Palette:
    """What scenes are made of. Few plugins share many kernels, so that compilation doesn't take
    most of the time.
    """

    integrators: tuple[str, ...] = tuple(BIAS)
    materials: tuple[str, ...] = tuple(MATERIALS)
    wrappers: tuple[str, ...] = WRAPPERS
    shapes: tuple[str, ...] = SHAPES
    lights: tuple[str, ...] = LIGHTS
    sensors: tuple[str, ...] = SENSORS

    @classmethod
    def of(cls, number: int) -> Palette:
        """A small one."""
        random = Random(number)
        return cls(
            integrators=(random.choice(tuple(BIAS)),),
            materials=("diffuse", random.choice(METALS), *random.sample(tuple(MATERIALS), 1)),
            wrappers=(random.choice(WRAPPERS),),
            shapes=tuple(random.sample(SHAPES, 2)),
            lights=tuple(random.sample(LIGHTS, 2)),
            sensors=(random.choice(SENSORS),),
        )


@st.composite
def materials(draw, palette: Palette, plain: bool = False):
    kind = draw(st.sampled_from(palette.materials))
    drawn = {name: draw(values) for name, values in MATERIALS[kind].items()}
    bsdf = {"type": kind, **drawn}
    if plain or draw(st.integers(0, 2)):
        return bsdf
    wrapper = draw(st.sampled_from(palette.wrappers))
    if wrapper == "twosided" and kind not in ONE_SIDED:
        return bsdf
    if wrapper in ("bumpmap", "normalmap") and kind == "null":
        return bsdf
    if wrapper == "textured":
        return {"type": "textured", "seed": draw(st.integers(0, 9))}
    more = {"mask": {"opacity": draw(reals(0.0, 1.0))}, "blendbsdf": {"weight": draw(reals(0, 1))}}
    if wrapper == "blendbsdf":
        more[wrapper]["other"] = draw(materials(palette, plain=True))
    return {"type": wrapper, "inner": bsdf, **more.get(wrapper, {})}


@st.composite
def objects(draw, palette: Palette):
    size = draw(logarithmic(0.01, 1.0))
    shape = draw(st.sampled_from(palette.shapes))
    radiance = draw(st.sampled_from([None] * 4 + [0.0, 1.0, [10.0, 1.0, 0.1], 1e8, 1e-8]))
    return {
        "shape": shape,
        "at": draw(points(1.5)),
        "size": size,
        "turn": [*draw(st.sampled_from([[1, 0, 0], [0, 1, 0], [1, 1, 1]])), draw(reals(0, 360))],
        "seed": draw(st.integers(0, 9)),
        "instances": draw(st.sampled_from([0, 0, 0, 0, 3])),
        "bsdf": draw(materials(palette)),
        "radiance": None if shape in NO_SOURCES else radiance,
    }


@st.composite
def lights(draw, palette: Palette):
    return {
        "type": draw(st.sampled_from(palette.lights)),
        "power": draw(st.sampled_from([1.0, 0.01, 100.0])),
        "at": draw(points(1.5)),
        "towards": draw(st.sampled_from([[0, 0, -1], [1, 1, -2], [0.1, -1, 0.3]])),
        "sun": draw(st.sampled_from([[0.3, 0.2, 0.8], [0.2, 0.9, 0.4], [-0.3, 1.0, 0.8]])),
        "seed": draw(st.integers(0, 9)),
    }


@st.composite
def poses(draw):
    """Where a sensor is and where it looks."""
    return {
        "origin": draw(st.one_of(st.just([0, -1.8, 0.4]), points(1.9))),
        "target": draw(st.sampled_from([[0, 0.5, -1], [0, 0, 0], [1, 1, -2]])),
    }


@st.composite
def sensors(draw, palette: Palette):
    return {
        "type": draw(st.sampled_from(palette.sensors)),
        **draw(poses()),
        "fov": draw(st.sampled_from([40, 80, 120])),
        "crop": draw(st.sampled_from([None, None, [1, 2, 5, 3]])),
    }


@st.composite
def parameters(draw, kind: str):
    """Of an integrator; patches enough for ``BIAS``."""
    chosen: dict[str, Any] = {
        "patches": draw(st.sampled_from([2048, 4096, 5000])),
        "patch_samples": draw(st.sampled_from([32, 64])),
        "sampler": draw(st.sampled_from(["multijitter", "independent", "scene", "ldsampler"])),
        "shadow_samples": draw(st.integers(1, 3)),
        "hide_emitters": draw(st.booleans()),
    }
    if kind != "source_selection":
        chosen |= {
            "secondary_samples": draw(st.sampled_from([1, 1, 3])),
            "residual_probability": draw(st.sampled_from([0.0, 0.0, 0.5, 1.0])),
            "irradiance_filter": draw(st.booleans()),
            "clamp_indirect": draw(st.sampled_from([0.0, 1e30])),
        }
    if kind == "envmap_hybrid":
        chosen |= {
            "gather_depth": draw(st.integers(1, 2)),
            "second_hit": draw(st.sampled_from(["cache", "shadow_rays"])),
            "lookup": "corrected",
            "maps": draw(st.sampled_from(["auto", "always"])),
            "map_resolution": draw(st.sampled_from([16, 64])),
            "distance_ratio": draw(reals(1.0, 8.0)),
            "mip_bias": draw(reals(-4.0, 0.0)),
        }
    return {name: value for name, value in chosen.items() if draw(st.booleans())}


#: Mistakes, and what the message of the error has to say.
MISTAKES = {
    "misspelt": "patchs",
    "range": '"patches" must be at least 16',
    "type": '"shadow_samples" must be an integer',
    "baker": "must be",
    "cluster": 'the scene has no shape "nothing"',
    "emitters": "the scene has no emitters",
    "surfaces": "the scene has no surfaces",
    "medium": "has a participating medium",
}


@st.composite
def surroundings(draw, palette: Palette):
    """The room, its walls and the light."""
    return {
        "room": draw(st.sampled_from(["closed", "closed", "open", "none", "gap", "window"])),
        "gap": draw(logarithmic(0.02, 0.5)),
        "wall": draw(reals(0.0, WHITEST_WALL)),
        "bumps": draw(st.one_of(st.none(), st.none(), st.none(), wall_bumps())),
        "plain": draw(st.sampled_from([False] * 4 + [True])),
        "lights": draw(st.lists(lights(palette), min_size=1, max_size=3)),
    }


@st.composite
def wall_bumps(draw):
    return {
        "type": draw(st.sampled_from(["bumpmap", "normalmap"])),
        "height": draw(st.sampled_from([0.1, 0.3, 1.0])),
        "seed": draw(st.integers(0, 9)),
    }


@st.composite
def histories(draw, palette: Palette, recipe: Recipe):
    """What has been before; see ``tests.fuzz.history``.

    before   what another scene had otherwise, which the integrator has rendered before
    start    where the camera or a shape was when it rendered this one for the first time
    given    a sensor is passed to ``mi.render``: of a scene that has none, or one elsewhere
    """
    before = draw(surroundings(palette))
    if not recipe["cubes"]:  # They name objects.
        before["objects"] = draw(st.lists(objects(palette), min_size=1, max_size=2))
    start: Recipe = {}
    if draw(st.booleans()):
        start["camera"] = draw(poses())
    if not start or draw(st.booleans()):
        start["object"] = draw(st.integers(0, len(recipe["objects"]) - 1))
        start["by"] = draw(points(1.5))
    elsewhere = {"elsewhere": draw(poses())}
    return {
        "before": draw(st.sampled_from([None, None, None, before])),
        "start": draw(st.sampled_from([None, None, start])),
        "given": draw(st.sampled_from([None, None, {}, elsewhere])),
    }


@st.composite
def recipes(draw, palette: Palette) -> Recipe:
    kind = draw(st.sampled_from(palette.integrators))
    recipe = {
        "integrator": kind,
        "parameters": draw(parameters(kind)),
        "objects": draw(st.lists(objects(palette), min_size=1, max_size=4)),
        **draw(surroundings(palette)),
        "sensor": draw(sensors(palette)),
        "scale": draw(st.sampled_from([1.0, 1.0, 1.0, 1e-4, 1e-2, 1e3, 1e5])),
        "offset": draw(st.sampled_from([[0, 0, 0], [0, 0, 0], [30, -20, 100]])),
        "cubes": [],
        "baker": None,
        "mistake": draw(st.sampled_from([None] * 19 + [draw(st.sampled_from(list(MISTAKES)))])),
    }
    if kind == "envmap_hybrid":
        recipe["cubes"] = draw(
            st.lists(
                st.tuples(st.integers(0, len(recipe["objects"]) - 1), reals(1.0, 10.0)),
                max_size=2,
                unique_by=lambda cube: cube[0],
            )
        )
        recipe["baker"] = draw(st.sampled_from([None, {"samples": 4}, {"shadow_samples": 2}]))
    _let_light_in(recipe)
    return recipe | draw(histories(palette, recipe))


def _let_light_in(recipe: Recipe) -> None:
    """Closed rooms aren't dark; where there is a gap or window, all light comes through it."""
    lights, room = recipe["lights"], recipe["room"]
    if room in ("gap", "window"):
        for item in recipe["objects"]:
            item["radiance"] = None
    if room == "window":
        lights[:] = [lights[0] | {"type": "sunsky"}]
    elif room == "gap":
        for light in lights:
            light["at"][0] = _aside(light["at"][0])
        origin = recipe["sensor"]["origin"]
        origin[0] = -_aside(origin[0])
    if room in ("closed", "gap") and all(light["type"] in FROM_OUTSIDE for light in lights):
        lights[0]["type"] = "area"


def _aside(x: float) -> float:
    """Not in the middle of the room, where its partition is."""
    return max(abs(x), 5 * THICK)


# ---------------------- Recipe → scene ----------------------


def scene_of(recipe: Recipe) -> dict:
    """What ``mi.load_dict`` makes the scene of."""
    place = at(*(recipe["scale"] * c for c in recipe["offset"])) @ scaled(recipe["scale"])
    parts: dict[str, Any] = {"type": "scene"}
    if recipe["given"] is None:
        parts["sensor"] = sensor_of(recipe)
    elif "elsewhere" in recipe["given"]:
        parts["sensor"] = sensor_of(
            recipe | {"sensor": recipe["sensor"] | recipe["given"]["elsewhere"]}
        )
    if recipe["mistake"] == "surfaces":
        return parts | {"sky": {"type": "constant"}}
    parts |= room_parts(recipe, place)
    for index, item in enumerate(recipe["objects"]):
        parts |= _object(f"object{index}", item, place, recipe["scale"])
    no_emitters = recipe["mistake"] == "emitters"
    if no_emitters:
        for part in parts.values():
            if isinstance(part, dict):
                part.pop("emitter", None)
    for index, light in enumerate([] if no_emitters else recipe["lights"]):
        if light["type"] in ("constant", "envmap", "sunsky") and "sky" in parts:
            continue  # Mitsuba takes only one.
        name = "sky" if light["type"] in ("constant", "envmap", "sunsky") else f"light{index}"
        parts[name] = _light(light, place, recipe["scale"])
    if recipe["mistake"] == "medium":
        fog = {"type": "homogeneous", "albedo": 0.5, "sigma_t": 1.0}
        ball = {"type": "sphere", "to_world": place @ scaled(0.1), "interior": fog}
        parts["fog"] = ball | {"bsdf": {"type": "null"}}
    return parts


def integrator_of(recipe: Recipe) -> dict:
    mistake = applicable_mistake(recipe)
    chosen = {"type": recipe["integrator"], **recipe["parameters"]}
    for index, ratio in recipe["cubes"]:
        names = {"shapes": ", ".join(_ids(index, recipe["objects"][index]))}
        chosen[f"cube{index}"] = {"type": "mipmap_cube", "distance_ratio": ratio, **names}
    if recipe["baker"]:
        chosen["baker"] = {"type": "envmap_bake", **recipe["baker"]}
    wrong = {
        "misspelt": {"patchs": 1},
        "range": {"patches": 1},
        "type": {"shadow_samples": "many"},
        "baker": {"baker": {"type": "path"}},
        "cluster": {"cube": {"type": "mipmap_cube", "shapes": "nothing"}},
    }
    return chosen | wrong.get(mistake, {})


def sensor_of(recipe: Recipe) -> dict:
    wanted, scale = recipe["sensor"], recipe["scale"]
    offset = np.array(recipe["offset"], float)
    origin, target = (scale * (np.array(wanted[p], float) + offset) for p in ("origin", "target"))
    if np.linalg.norm(target - origin) < 1e-3 * scale:
        target = origin + [0, scale, 0]
    d = (target - origin) / np.linalg.norm(target - origin)
    up = [0, 0, 1] if abs(d[2]) < 0.99 else [0, 1, 0]
    to_world = mi.ScalarTransform4f().look_at(origin.tolist(), target.tolist(), up)
    crop = {}
    if wanted["crop"]:
        names = ("crop_offset_x", "crop_offset_y", "crop_width", "crop_height")
        crop = dict(zip(names, wanted["crop"], strict=True))
    sensor = {
        "type": wanted["type"],
        "to_world": to_world,
        "near_clip": 1e-4 * scale,
        "far_clip": 1e4 * scale,
        "sampler": {"type": "independent"},
        "film": film(SIZE, SIZE, **crop),
    }
    if wanted["type"] == "orthographic":
        sensor["to_world"] = to_world @ scaled(scale)
        sensor |= {"near_clip": 1e-4, "far_clip": 1e4}
    else:
        sensor["fov"] = wanted["fov"]
    if wanted["type"] == "thinlens":
        sensor |= {"aperture_radius": 0.05 * scale, "focus_distance": scale}
    return sensor


def _ids(index: int, item: Recipe) -> list[str]:
    name = f"object{index}"
    return [f"{name}copy{i}" for i in range(item["instances"])] or [name]


def _object(name: str, item: Recipe, place, scale: float) -> dict:
    local = at(*item["at"])
    # Mitsuba warns of turned SDF grids, and light leaks through turned instances of them.
    if item["shape"] != "sdfgrid":
        local = local @ rotation(item["turn"])
    local = local @ scaled(item["size"])
    bsdf = {"bsdf": material(item["bsdf"], scale * item["size"])}
    if not item["instances"]:
        lit = {}
        if item["radiance"] is not None:
            lit = {"emitter": _emission(item["radiance"])}
        return {name: _shape(item, place @ local) | bsdf | lit}
    group = {"type": "shapegroup", "part": _shape(item, scaled(1)) | bsdf}
    copies = {
        f"{name}copy{i}": {
            "type": "instance",
            "to_world": place @ at(0.3 * i, 0.1 * i, 0) @ local,
            "group": {"type": "ref", "id": f"{name}group"},
        }
        for i in range(item["instances"])
    }
    return {f"{name}group": group, **copies}


def rotation(turn: list[float]) -> mi.ScalarTransform4f:
    """About an axis, by an angle. Mitsuba shears if the axis isn't of length one, and samples of
    the light of a sheared sphere aren't on it.
    """
    *axis, angle = turn
    return mi.ScalarTransform4f().rotate(np.array(axis) / np.linalg.norm(axis), angle)


def _emission(radiance) -> dict:
    return {"type": "area", "radiance": {"type": "rgb", "value": radiance}}


def _shape(item: Recipe, to_world) -> dict | mi.Object:
    kind, random = item["shape"], np.random.default_rng(item["seed"])
    if kind == "triangles":
        return {"type": "ply", "filename": _triangles(item["seed"]), "to_world": to_world}
    if kind == "curve":
        return {"type": "bsplinecurve", "filename": _curve(item["seed"]), "to_world": to_world}
    if kind == "sdfgrid":
        grid = random.uniform(-0.2, 0.5, (4, 4, 4, 1)).astype(np.float32)
        return {"type": "sdfgrid", "grid": mi.TensorXf(grid), "to_world": to_world}
    return {"type": kind, "to_world": to_world}


def _folder() -> Path:
    folder = Path(tempfile.gettempdir()) / "envmap-fuzz"
    folder.mkdir(exist_ok=True)
    return folder


def _triangles(number: int) -> str:
    """Random triangles: some are points or lines, some have no normals to speak of."""
    path = _folder() / f"triangles{number}.ply"
    random = np.random.default_rng(number)
    vertices = random.uniform(-1, 1, (30, 3))
    faces = random.integers(0, 30, (20, 3))
    faces[0] = faces[0, 0]  # a point
    vertices[faces[1, 2]] = vertices[faces[1, 0]]  # a line
    mesh = mi.Mesh("triangles", 30, 20, has_vertex_normals=number % 2 == 1)
    values = mi.traverse(mesh)
    values["vertex_positions"] = vertices.astype(np.float32).ravel()
    values["faces"] = faces.astype(np.uint32).ravel()
    if number % 2:
        normals = random.normal(size=(30, 3))
        normals[:3] = 0
        normals[3] = np.nan
        values["vertex_normals"] = normals.astype(np.float32).ravel()
    values.update()
    mesh.write_ply(str(path))
    return str(path)


def _curve(number: int) -> str:
    path = _folder() / f"curve{number}.txt"
    walk = np.cumsum(np.random.default_rng(number).uniform(-0.5, 0.5, (6, 3)), axis=0)
    path.write_text("".join(f"{x} {y} {z} 0.1\n" for x, y, z in walk))
    return str(path)


def material(recipe: Recipe, size: float) -> dict:
    """A material's dictionary, for an object of that size: bumps are as high."""
    kind = recipe["type"]
    if kind == "textured":
        return {"type": "diffuse", "reflectance": _texture(recipe["seed"], raw=False)}
    if kind in WRAPPERS:
        return _wrapped(recipe, material(recipe["inner"], size), size)
    return {name: _value(name, value) for name, value in recipe.items()}


def _wrapped(recipe: Recipe, inner: dict, size: float) -> dict:
    kind = recipe["type"]
    if kind == "blendbsdf":
        both = {"a": inner, "b": material(recipe["other"], size)}
        return {"type": kind, "weight": recipe["weight"], **both}
    if kind == "mask":
        return {"type": kind, "opacity": recipe["opacity"], "inner": inner}
    if kind == "normalmap":
        return {"type": kind, "normalmap": _texture(0, raw=True), "inner": inner}
    if kind == "bumpmap":
        bumps = {"arbitrary": _texture(0, raw=True), "scale": size}
        return {"type": kind, **bumps, "inner": inner}
    return {"type": kind, "inner": inner}


def _texture(number: int, raw: bool) -> dict:
    """Texels of 0, 1 and what lies between."""
    texels = np.clip(np.random.default_rng(number).uniform(-0.5, 1.5, (4, 4, 3)), 0, 1)
    return {"type": "bitmap", "bitmap": mi.Bitmap(texels.astype(np.float32)), "raw": raw}


def _value(name: str, value):
    if "reflectance" in name or name == "base_color":
        return {"type": "rgb", "value": value}
    return value


def _light(light: Recipe, place, scale: float) -> dict:
    kind, power = light["type"], light["power"]
    where = (place @ mi.ScalarPoint3f(light["at"])).numpy().tolist()
    towards = (np.array(where) + scale * np.array(light["towards"])).tolist()
    if kind == "point":
        return {"type": kind, "position": where, "intensity": power * scale**2}
    if kind == "spot":
        aim = mi.ScalarTransform4f().look_at(where, towards, [0, 1, 0.1])
        return {"type": kind, "to_world": aim, "intensity": power * scale**2, "cutoff_angle": 40}
    if kind == "directional":
        return {"type": kind, "direction": light["towards"], "irradiance": power}
    if kind == "constant":
        return {"type": kind, "radiance": power}
    if kind == "envmap":
        texels = np.random.default_rng(light["seed"]).uniform(0, power, (4, 8, 3))
        return {"type": kind, "bitmap": mi.Bitmap(texels.astype(np.float32))}
    if kind == "sunsky":
        return {"type": kind, "sun_direction": light["sun"]}
    lamp = at(*light["at"]) @ mi.ScalarTransform4f().rotate([1, 0, 0], 180) @ scaled(0.3)
    return {"type": "rectangle", "to_world": place @ lamp} | grey(0) | {"emitter": _emission(power)}


# ---------------------- The check ----------------------


@dataclass(frozen=True)
class Means:
    """Means of a picture over independent seeds."""

    value: float
    error: float

    @classmethod
    def of(cls, scene, sensor, integrator, spp: int, seeds: int) -> Means:
        pictures = [render(scene, sensor, integrator, spp, seed) for seed in range(seeds)]
        values = np.array([picture.mean(dtype=np.float64) for picture in pictures])
        return cls(values.mean(), values.std(ddof=1) / math.sqrt(seeds))


class NotFinite(AssertionError):
    """A picture has values that are no numbers, or infinite."""


def render(scene, sensor, integrator, spp: int, seed: int) -> np.ndarray:
    """A picture, all its pixels finite and, but for residuals, not negative."""
    picture = np.array(mi.render(scene, None, sensor, integrator, seed=seed, spp=spp))
    if not np.isfinite(picture).all():
        raise NotFinite(f"{(~np.isfinite(picture)).sum()} values aren't finite")
    estimates_residual = getattr(integrator, "residual_probability", 0) > 0
    assert estimates_residual or (picture >= 0).all(), f"down to {picture.min()}"
    return picture


def load_scene(recipe: Recipe) -> tuple[mi.Scene, mi.Sensor]:
    """The scene, and the sensor to render: its own, or one to be passed."""
    scene = mi.load_dict(scene_of(recipe), optimize=False)
    if recipe["given"] is None:
        return scene, scene.sensors()[0]
    return scene, mi.load_dict(sensor_of(recipe))


def check(recipe: Recipe) -> float:
    """Raise ``AssertionError`` if the recipe's integrator doesn't do as it should.

    Returns the error that the cache states.
    """
    mistake = applicable_mistake(recipe)
    if mistake:
        check_mistake(recipe, MISTAKES[mistake])
        return 0.0
    ours = mi.load_dict(integrator_of(recipe))
    scene, sensor = _after_history(recipe, ours)
    width, height = recipe["sensor"]["crop"][2:] if recipe["sensor"]["crop"] else (SIZE, SIZE)
    picture = render(scene, sensor, ours, 16, 0)
    assert picture.shape == (height, width, 3)
    ceiling = brightest(recipe)
    assert picture.max() <= ceiling, f"up to {picture.max():g}, {ceiling:g} is possible"
    stated = ours.prepare(scene, sensor, 16).relative_error
    hidden = recipe["parameters"].get("hide_emitters", False)
    text = json.dumps(recipe)
    if hidden and '"mask"' in text:
        return stated  # Of what a mask reflects, path hides what it lets through to the sky, too.
    if recipe["scale"] < TINIEST:
        return stated
    path = mi.load_dict({"type": "path", "hide_emitters": hidden})
    scene_of_path = scene
    if any(f'"{kind}"' in text for kind in SEE_THROUGH):
        scene_of_path = mi.load_dict({"sky": BLACK_SKY} | scene_of(recipe), optimize=False)
    for spp in (16, 256):  # The more expensive look only decides where the first one doubts.
        try:
            expected = Means.of(scene_of_path, sensor, path, 4 * spp, 8)
        except NotFinite:
            return stated  # Normals that are no numbers, for example.
        found = Means.of(scene, sensor, ours, spp, 8)
        # All of ours share one cache, whose own noise isn't in their scatter: it's stated.
        stated = ours.prepare(scene, sensor, spp).relative_error
        problem = disagreement(found, expected, BIAS[recipe["integrator"]] + STATED * stated)
        if not problem:
            return stated
    raise AssertionError(f"{problem}; stated error {stated:g}")


def _after_history(recipe: Recipe, ours: mi.Integrator) -> tuple[mi.Scene, mi.Sensor]:
    """The recipe's scene, after the integrator has rendered what was before, and its sensor."""
    earlier = earlier_scene(recipe)
    if earlier:
        render(*load_scene(earlier), ours, 16, 0)
    if not recipe["start"]:
        return load_scene(recipe)
    scene, sensor = load_scene(first_frame(recipe))
    render(scene, sensor, ours, 16, 0)
    move(scene, sensor, recipe, sensor_of(recipe)["to_world"])
    return scene, sensor


def applicable_mistake(recipe: Recipe) -> str | None:
    """The mistake, unless the integrator has nothing that could be wrong in this way."""
    if recipe["mistake"] in ("baker", "cluster") and recipe["integrator"] != "envmap_hybrid":
        return None
    return recipe["mistake"]


def check_mistake(recipe: Recipe, message: str) -> None:
    try:
        scene, sensor = load_scene(recipe)
        render(scene, sensor, mi.load_dict(integrator_of(recipe)), 1, 0)
    except (ValueError, TypeError, RuntimeError) as error:
        text = condense(error.__cause__ or error)  # ``mi.render`` wraps what integrators raise.
        assert message in text, text
        # Mitsuba itself complains of what nothing reads, and says where.
        names = (recipe["integrator"], "mipmap_cube", "At dictionary node", "While loading")
        assert text.startswith(names), text
        assert recipe["integrator"] in text or "mipmap_cube" in text, text
        return
    raise AssertionError(f'no error, expected "{message}"')


def disagreement(ours: Means, path: Means, bias: float) -> str:
    """What is wrong, if anything is."""
    difference = abs(ours.value - path.value)
    noise = SIGMAS * math.hypot(ours.error, path.error)
    if difference <= bias * max(path.value, 1e-20) + noise:
        return ""
    return f"mean {ours.value:g} ± {ours.error:g}, path's is {path.value:g} ± {path.error:g}"


def brightest(recipe: Recipe) -> float:
    """Radiance [W/m²/sr] that no pixel may exceed, infinite where nothing bounds it.

    Where sources are surfaces or skies, a surface of albedo ρ shows at most what it receives: at
    most L / (1 - ρ). Samples of single pixels may exceed their mean: by less than 4 times, since
    each of their parts is bounded by multiple importance sampling. What points and directions send
    into a narrow lobe has no such bound, and neither have the sun and the estimate of a residual.
    """
    if recipe["parameters"].get("residual_probability"):
        return math.inf
    if any(light["type"] not in ("constant", "envmap", "area") for light in recipe["lights"]):
        return math.inf
    radiance = [light["power"] for light in recipe["lights"]]
    radiance += [np.max(item["radiance"]) for item in recipe["objects"] if item["radiance"]]
    return 4 * max(radiance) / (1 - WHITEST_WALL)


# ---------------------- Many ----------------------


def run_batch(number: int, count: int, report: Path) -> None:
    """Check ``count`` scenes; ``report`` gets a line of JSON for the start and end of each."""
    with report.open("a", encoding="utf-8") as lines:

        def note(**entry):
            lines.write(json.dumps(entry) + "\n")
            lines.flush()

        @seed(number)
        @settings(
            max_examples=count,
            phases=[Phase.generate],
            database=None,
            deadline=None,
            suppress_health_check=list(HealthCheck),
        )
        @given(recipes(Palette.of(number)))
        def all_of_them(recipe):
            note(started=recipe)
            try:
                stated = check(recipe)
            except Exception as error:
                note(
                    failed=condense(error.__cause__ or error),
                    trace=traceback.format_exc(),
                    recipe=recipe,
                )
            else:
                note(passed=True, stated=stated)

        all_of_them()


def run_many(count: int, batch: int, first: int, folder: Path) -> int:
    """Check ``count`` scenes in processes of ``batch`` each; returns how many failed."""
    folder.mkdir(parents=True, exist_ok=True)
    done = failed = 0
    number = first
    while done < count:
        report = folder / f"batch{number}.jsonl"
        report.unlink(missing_ok=True)
        command = [sys.executable, "-m", "tests.fuzz.scenes", "--batch", str(number)]
        command += ["--count", str(min(batch, count - done)), "--out", str(folder)]
        try:
            code = subprocess.run(command, timeout=HANGS_AFTER * batch / 10).returncode
        except subprocess.TimeoutExpired:
            code = "timeout"
        entries = [json.loads(line) for line in report.read_text().splitlines()]
        started = [entry["started"] for entry in entries if "started" in entry]
        problems = [entry for entry in entries if "failed" in entry]
        if code != 0 and started:
            problems.append({"failed": f"the process ended with {code}", "recipe": started[-1]})
        for index, problem in enumerate(problems):
            path = folder / f"failed-{number}-{index}.json"
            path.write_text(json.dumps(problem["recipe"], indent=1))
            print(f"{path}: {problem['failed']}", flush=True)
        done += max(len(started), 1)
        failed += len(problems)
        number += 1
        print(f"{done} scenes, {failed} failed", flush=True)
    return failed


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz.scenes", description=__doc__)
    parser.add_argument("--count", type=int, default=2000, help="scenes (default: 2000)")
    parser.add_argument("--each", type=int, default=50, help="scenes of each batch (default: 50)")
    parser.add_argument("--first", type=int, default=0, help="number of the first batch")
    parser.add_argument("--batch", type=int, help="check this batch in this process")
    parser.add_argument("--repeat", type=Path, help="check the scene of this recipe")
    parser.add_argument("--out", type=Path, default=Path("renders/fuzz"), help="folder")
    args = parser.parse_args()
    if args.batch is None and args.repeat is None:
        return 1 if run_many(args.count, args.each, args.first, args.out) else 0
    mi.set_variant("llvm_ad_rgb")
    if args.repeat:
        check(json.loads(args.repeat.read_text()))
    else:
        run_batch(args.batch, args.count, args.out / f"batch{args.batch}.jsonl")
    return 0


if __name__ == "__main__":
    sys.exit(main())
