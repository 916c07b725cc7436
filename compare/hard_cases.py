"""The hard cases, by name.

Bounds on pixels: where sources are surfaces or skies of radiance L at most and surfaces reflect
the part ρ, no radiance exceeds L / (1 - ρ); where they are points of intensity I at the distance
d, or directions of irradiance E, L is replaced by ρ I / (π d²) or ρ E / π. ``enclosed`` computes
the first. Single samples may exceed their mean, but each of their parts is bounded by multiple
importance sampling, and pixels average over ``spp`` of them.
"""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from compare.gallery import Case
from compare.scene_kit import (
    BLACK_SKY,
    Description,
    at,
    ball,
    block,
    box,
    camera,
    checkers,
    cluster,
    curve,
    emitting,
    film,
    grey,
    lamp,
    mesh,
    open_scene,
    placed,
    room,
    scaled,
    texture,
)

WIDTH, HEIGHT = 24, 18
LAMP = 10.0
"""Radiance of the room's lamp."""

SKY = {"type": "constant", "radiance": 1.0}
BLOCK = (-0.5, 0.6, -1.5)
"""Centre of the room's block, 0.4 in half width."""

ROUGH_LOOK = {"source_selection": 0.10}
"""Where what is seen first is so small or so close to others that patches average over it."""


def enclosed(radiance: float, reflectance: float) -> float:
    """Bound of all radiance where sources and surfaces have no more than these."""
    return radiance / (1 - reflectance)


ROOM = enclosed(LAMP, 0.7)
"""... in the room as it is."""


# ---------------------- Scenes ----------------------


def look(origin=(0, -1.8, 0.4), target=(0, 0.5, -1), **more) -> Description:
    return camera(WIDTH, HEIGHT, origin, target, **more)


def small_room(**changes) -> Description:
    return room(**{"sensor": look()} | changes)


def small_open(**changes) -> Description:
    return open_scene(**{"sensor": look(), "sky": SKY} | changes)


def with_ball(bsdf: str, radiance: float | None = None, **settings) -> Description:
    """The room with a ball of another material, which may shine itself."""
    light = {} if radiance is None else emitting(radiance)
    return small_room(ball=ball(0.4, 0.2, -1.6, 0.4) | of(bsdf, **settings) | light)


def of(bsdf: str, **settings) -> Description:
    return {"bsdf": {"type": bsdf} | settings}


def axis_aligned(direction, up=(0, 0, 1), origin=(0.0, -1.5, -1.0)) -> Description:
    """An orthographic sensor all of whose rays have two components that are zero."""
    target = [o + d for o, d in zip(origin, direction, strict=True)]
    to_world = mi.ScalarTransform4f().look_at(origin, target, up)
    sensor = look(type="orthographic", to_world=to_world @ scaled(0.8), near_clip=1e-6)
    del sensor["fov"]
    return sensor


def shelf(half_width: float) -> Description:
    """A box around the block, seen from inside and outside."""
    cube = {"type": "cube", "to_world": at(*BLOCK) @ scaled(half_width)}
    return cube | {"bsdf": {"type": "twosided", "inner": grey(0.4)["bsdf"]}}


def bar() -> Description:
    to_world = at(0, 0.5, -0.9) @ mi.ScalarTransform4f().scale([1.9, 0.1, 0.1])
    return {"type": "cube", "to_world": to_world} | grey(0.3)


def wall(x: float, thickness: float, **more) -> Description:
    """Across the room at x."""
    to_world = at(x, 0, 0) @ mi.ScalarTransform4f().scale([thickness / 2, 2, 2])
    return {"type": "cube", "to_world": to_world} | grey(0.5) | more


def thin_wall() -> Description:
    """A wall of a ten thousandth of the room between a bright half and a dark one, seen."""
    return small_room(
        wall=wall(0.0, 4e-4),
        lamp=lamp(x=-1.2, z=1.9, half_width=0.4),
        candle=lamp(x=1.2, z=1.9, half_width=0.4, power=0.01),
        sensor=look(origin=(1.2, -1.8, 0.4), target=(1, 0.5, -1)),
    )


def instances(columns: int, size: float) -> Description:
    """Balls and blocks on the floor, ``columns``² of each, as instances of one group: Mitsuba
    compiles code for each of them."""
    group = {
        "type": "shapegroup",
        "ball": ball(0, 0, 0, size) | grey(0.7),
        "block": block(0, 0, 1.8 * size, 0.8 * size) | grey(0.3),
    }
    places = np.linspace(-1.8, 1.8, columns)
    copies = {
        f"copy{i}-{j}": {
            "type": "instance",
            "to_world": at(float(x), float(y), -2 + size),
            "group": {"type": "ref", "id": "group"},
        }
        for i, x in enumerate(places)
        for j, y in enumerate(places)
    }
    return small_room(group=group, ball=None, block=None) | copies


def many_shapes(count: int, make) -> Description:
    """Small shapes all over the room; ``make`` gives one of a place and a size."""
    places = np.random.default_rng(0).uniform([-1.8, -1.2, -1.95], [1.8, 1.8, -1.0], (count, 3))
    shapes = {f"small{i}": make(*map(float, p), 0.02) | grey(0.6) for i, p in enumerate(places)}
    return small_room(ball=None, block=None) | shapes


def million_triangles() -> Description:
    """A rolling floor of 1,000,000 triangles, which hides the room's own."""
    n = 708
    x, y = np.meshgrid(np.linspace(-2, 2, n), np.linspace(-2, 2, n))
    z = -1.9 + 0.05 * np.sin(9 * x) * np.cos(7 * y)
    i = np.arange(n * n).reshape(n, n)
    a, b, c, d = (x.ravel() for x in (i[:-1, :-1], i[:-1, 1:], i[1:, :-1], i[1:, 1:]))
    faces = np.concatenate([np.stack([a, b, d], 1), np.stack([a, d, c], 1)])
    vertices = np.stack([x, y, z], -1).reshape(-1, 3)
    return small_room(floor=mesh(vertices, faces, bsdf=grey(0.5)["bsdf"]))


def merged_meshes() -> Description:
    blocks = {f"block{i}": block(-1.5 + 0.3 * i, 0.6, -1.8, 0.1) | grey(0.7) for i in range(11)}
    return small_room(block=None, ball=None, **blocks)


PYRAMID = [[-0.3, -0.3, 0], [0.3, -0.3, 0], [0.3, 0.3, 0], [-0.3, 0.3, 0], [0, 0, 0.6]]
PYRAMID_FACES = [[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]]


def pyramid(more_faces=(), normals=None) -> Description:
    vertices = np.array(PYRAMID) + [0.4, 0.2, -2]
    bsdf = {"type": "twosided", "inner": grey(0.6)["bsdf"]}
    return small_room(ball=mesh(vertices, [*PYRAMID_FACES, *more_faces], normals, bsdf=bsdf))


def broken_normals() -> Description:
    normals = np.array([[0, 0, 1], [np.nan] * 3, [0, 0, 0], [1, 0, 0], [0, 0, 1]])
    return pyramid(normals=normals)


def triangle() -> Description:
    shape = mesh([[-1, 0, -1], [1, 0, -1], [0, 0.5, 1]], [[0, 1, 2]])
    return {"type": "scene", "sensor": look(target=(0, 0, 0)), "sky": SKY, "triangle": shape}


def empty_mesh() -> Description:
    return small_room(nothing=mesh(np.zeros((0, 3)), np.zeros((0, 3))))


def point_mesh() -> Description:
    return small_room(nothing=mesh([[0.2, 0, -1]] * 3, [[0, 1, 2]]))


def sky_map() -> Description:
    """Bright in one texel of 32."""
    texels = np.full((4, 8, 3), 0.5, np.float32)
    texels[1, 2] = 10
    return {"type": "envmap", "bitmap": mi.Bitmap(texels)}


def lit_by(light: Description) -> Description:
    return small_room(lamp=None, light=light)


def spot() -> Description:
    to_world = mi.ScalarTransform4f().look_at([0, 0, 1.5], [0, 0.4, -2], [0, 1, 0])
    return lit_by({"type": "spot", "to_world": to_world, "intensity": 10.0, "cutoff_angle": 40})


def many_lamps() -> Description:
    lamps = {
        f"lamp{i}{j}": lamp(x=-1.75 + 0.5 * i, y=-1.75 + 0.5 * j, z=1.9, half_width=0.05)
        for i in range(8)
        for j in range(8)
    }
    return small_room(lamp=None) | lamps


def behind(bsdf: str, **settings) -> Description:
    """A lamp almost as wide as the room is behind a pane, so that only chance finds it."""
    to_world = at(0, 0, 1.5) @ scaled(2)
    pane = {"type": "rectangle", "to_world": to_world} | of(bsdf, **settings)
    return small_room(pane=pane, lamp=lamp(z=1.9, half_width=1.8, power=1))


def leaf() -> Description:
    half = {"type": "mask", "opacity": 0.5, "inner": {"type": "twosided", **grey(0.6)}}
    shape = {"type": "rectangle", "to_world": at(0.4, -0.4, -1.2) @ scaled(0.4)}
    return small_room(leaf=shape | {"bsdf": half}, pane=ball(-0.2, -0.6, -1.6, 0.2) | of("null"))


def mirrored(**walls) -> Description:
    return small_room(walls=box(2.0) | walls)


def two_sensors() -> Description:
    other = look(origin=(1.5, 1.5, 1), target=(0, 0, -1))
    return small_room(sensor=look(), second=other)


def filmed(**settings) -> Description:
    return small_room(sensor=look() | {"film": film(WIDTH, HEIGHT) | settings})


def sdf() -> Description:
    """A ball of a grid of signed distances."""
    axis = np.linspace(-0.5, 0.5, 16)
    distance = np.linalg.norm(np.stack(np.meshgrid(axis, axis, axis), -1), axis=-1) - 0.4
    grid = mi.TensorXf(distance[..., None].astype(np.float32))
    shape = {"type": "sdfgrid", "grid": grid, "to_world": at(0, -0.2, -1.9) @ scaled(0.8)}
    return small_room(ball=shape | grey(0.6))


def strand(kind: str) -> Description:
    t = np.linspace(0, 12, 24)
    spiral = np.stack([0.4 + 0.3 * np.cos(t), 0.2 + 0.3 * np.sin(t), -2 + 0.08 * t], axis=1)
    return small_room(ball=curve(kind, spiral, 0.05, **grey(0.6)))


def cylinder() -> Description:
    shape = {"type": "cylinder", "p0": [0.4, 0.2, -2], "p1": [0.4, 0.2, -1.4], "radius": 0.3}
    disk = {"type": "disk", "to_world": at(0.4, 0.2, -1.4) @ scaled(0.3)}
    both = {"type": "twosided", "inner": grey(0.6)["bsdf"]}
    return small_room(ball=shape | {"bsdf": both}, lid=disk | grey(0.4))


def textured_lamp() -> Description:
    shape = lamp(z=1.9)
    return small_room(lamp=shape | {"emitter": {"type": "area", "radiance": checkers(0, LAMP)}})


def fog(**where) -> Description:
    return {"type": "homogeneous", "albedo": 0.5, "sigma_t": 1.0} | where


def bumped(kind: str) -> Description:
    if kind == "normalmap":
        texels = np.full((8, 8, 3), [0.5, 0.5, 1.0])
        texels[::2, ::2] = [0.6, 0.45, 0.98]
        return with_ball(kind, normalmap=texture(texels, raw=True), inner=grey(0.6)["bsdf"])
    return with_ball(kind, arbitrary=checkers(0, 0.02) | {"raw": True}, inner=grey(0.6)["bsdf"])


# ---------------------- Cubes ----------------------

HALF_WIDTH = 1.5 * 0.4
"""Of the cube around the block, to a part in a hundred: it is that of surface points."""

BLOCK_CUBE = {"desk": cluster("block")}
BOTH = {"desk": cluster()}

CUBES = {
    "camera in a cube": Case(
        lambda: small_room(sensor=look(origin=(0, -0.6, -1))), ROOM, maps=BOTH
    ),
    "camera on a cube's face": Case(
        lambda: small_room(sensor=look(origin=(-0.5, 0.6 - HALF_WIDTH, -1.2))),
        ROOM,
        maps=BLOCK_CUBE,
    ),
    "camera on a cube's edge": Case(
        lambda: small_room(sensor=look(origin=(-0.5, 0.6 - HALF_WIDTH, -1.5 + HALF_WIDTH))),
        ROOM,
        maps=BLOCK_CUBE,
    ),
    "camera on a cube's corner": Case(
        lambda: small_room(
            sensor=look(origin=(-0.5 + HALF_WIDTH, 0.6 - HALF_WIDTH, -1.5 + HALF_WIDTH))
        ),
        ROOM,
        maps=BLOCK_CUBE,
    ),
    "camera at a cube's centre, in the block": Case(
        lambda: small_room(sensor=look(origin=BLOCK, target=(0, 0, -1))), ROOM, maps=BLOCK_CUBE
    ),
    "rays along an axis": Case(lambda: small_room(sensor=axis_aligned((0, 1, 0))), ROOM, maps=BOTH),
    "rays along an axis, downwards": Case(
        lambda: small_room(sensor=axis_aligned((0, 0, -1), up=(0, 1, 0), origin=(0, 0.3, 0))),
        ROOM,
        maps=BOTH,
    ),
    "surfaces on a cube's faces": Case(
        lambda: small_room(shelf=shelf(0.4)),
        ROOM,
        maps={"desk": cluster("block", distance_ratio=1.0)},
    ),
    "a shelf on a larger cube's faces": Case(
        lambda: small_room(shelf=shelf(HALF_WIDTH), sensor=look(origin=(0.05, -1.8, 0.4))),
        ROOM,
        maps=BLOCK_CUBE,
        bias=ROUGH_LOOK,
    ),
    "an object straddles a cube": Case(lambda: small_room(bar=bar()), ROOM, maps=BOTH),
    "a cube larger than the scene": Case(
        small_room, ROOM, maps={"desk": cluster(distance_ratio=50.0)}, warnings=1
    ),
    "overlapping cubes": Case(
        small_room,
        ROOM,
        maps={"a": cluster("block", distance_ratio=2.0), "b": cluster("ball", distance_ratio=3.0)},
    ),
    "nested cubes": Case(
        small_room,
        ROOM,
        maps={"a": cluster("block", distance_ratio=1.2), "b": cluster("ball", distance_ratio=4.0)},
    ),
    "the walls as a cluster": Case(
        small_room, ROOM, maps={"all": cluster("walls", distance_ratio=1.0)}, warnings=1
    ),
    "a cube's centre in another object": Case(
        lambda: small_room(
            left=block(-1.0, 0.6, -1.5, 0.3) | grey(0.5),
            right=block(0.0, 0.6, -1.5, 0.3) | grey(0.5),
            ball=None,
        ),
        ROOM,
        maps={"desk": cluster("left", "right")},
        bias=ROUGH_LOOK,
    ),
    "a cube's centre in a wall": Case(
        lambda: small_room(wall=wall(0.0, 0.1), sensor=look(origin=(-1, -1.8, 0.4))),
        ROOM,
        maps=BOTH,
    ),
    "a lamp in a cube": Case(
        lambda: small_room(lamp=lamp(x=-0.5, y=0.1, z=-1.0, half_width=0.1, power=50)),
        enclosed(50, 0.7),
        maps=BLOCK_CUBE,
        spp=64,
        precision=0.04,
    ),
    "a lamp on a cube's face": Case(
        lambda: small_room(lamp=lamp(x=-0.5, y=0.6, z=-1.5 + HALF_WIDTH, half_width=0.2, power=50)),
        enclosed(50, 0.7),
        maps=BLOCK_CUBE,
        spp=256,
        precision=0.04,
    ),
    "a lamp beyond a cube": Case(small_room, ROOM, maps=BLOCK_CUBE),
    "a lamp as a cluster": Case(small_room, ROOM, maps={"lamp": cluster("lamp")}),
    "glass as a cluster": Case(
        lambda: with_ball("dielectric"), ROOM, maps={"ball": cluster("ball")}, warnings=1
    ),
    "maps of found clusters": Case(small_room, ROOM, maps={"maps": "always"}),
}

# ---------------------- Scale, place, meshes ----------------------

GEOMETRY = {
    "1/10,000 of the size": Case(lambda: placed(small_room(), 1e-4), ROOM, maps=BOTH),
    "1/100 of the size": Case(lambda: placed(small_room(), 1e-2), ROOM, maps=BOTH),
    "1,000 times the size": Case(lambda: placed(small_room(), 1e3), ROOM, maps=BOTH),
    "100,000 times the size": Case(lambda: placed(small_room(), 1e5), ROOM, maps=BOTH),
    "far from the origin": Case(
        lambda: placed(small_room(), offset=(3000, -2000, 1000)), ROOM, maps=BOTH
    ),
    "10,000 rooms from the origin": Case(
        lambda: placed(small_room(), offset=(4e4, 0, 0)), ROOM, maps=BOTH
    ),
    "zero-area triangles": Case(lambda: pyramid([[0, 0, 0], [0, 1, 0], [4, 4, 2]]), ROOM),
    "normals that are no numbers": Case(broken_normals, ROOM),
    "a mesh that is a single point": Case(point_mesh, ROOM),
    "a single triangle": Case(triangle, enclosed(1, 0.5)),
    "merged meshes": Case(merged_meshes, ROOM, merged=True),
    "million triangles": Case(million_triangles, ROOM),
    "300 shapes": Case(lambda: many_shapes(300, ball), ROOM),
    "10,000 shapes, merged": Case(lambda: many_shapes(10_000, block), ROOM, merged=True),
    "instances": Case(lambda: instances(4, 0.1), ROOM),
    "instances as a cluster": Case(
        lambda: instances(3, 0.2), ROOM, maps={"desk": cluster("copy0-0", "copy1-1")}
    ),
    "disk and cylinder": Case(cylinder, ROOM),
    "linear curve": Case(lambda: strand("linearcurve"), ROOM),
    "B-spline curve": Case(lambda: strand("bsplinecurve"), ROOM),
    "signed distances": Case(sdf, ROOM),
    "a thin wall": Case(thin_wall, enclosed(0.01, 0.7) + 1e-4),
}

# ---------------------- Light ----------------------

POINT = {"type": "point", "position": [0, 0, 0.5], "intensity": 10.0}
SUN = {"type": "directional", "direction": [0.3, 0.4, -1], "irradiance": 3.0}

LIGHT = {
    "no emitters": Case(lambda: small_room(lamp=None), error="the scene has no emitters"),
    "an emitter of nothing": Case(lambda: small_room(lamp=lamp(z=1.9, power=0)), 0.0),
    "only a point": Case(lambda: lit_by(POINT), enclosed(10 / np.pi / 1.5**2, 0.7)),
    "only a spot": Case(spot, enclosed(10 / np.pi / 1.2**2, 0.7)),
    "only a direction": Case(lambda: small_open(sky=SUN), enclosed(3 / np.pi, 0.7)),
    "a direction that walls keep out": Case(lambda: lit_by(SUN), 0.0),
    "a constant sky": Case(small_open, enclosed(1, 0.7)),
    "a sky of one bright texel": Case(lambda: small_open(sky=sky_map()), enclosed(10, 0.7)),
    "sun and sky": Case(
        lambda: small_open(sky={"type": "sunsky", "sun_direction": [0.3, 0.2, 0.8]}), 1e6
    ),
    "an open scene with a lamp": Case(lambda: small_open(sky=None, lamp=lamp(z=1.9)), ROOM),
    "a lamp of 1e8 beside one of 1e-8": Case(
        lambda: small_room(
            lamp=lamp(z=1.9, power=1e8), ball=ball(0.4, 0.2, -1.6, 0.4) | grey(0.5) | emitting(1e-8)
        ),
        enclosed(1e8, 0.7),
    ),
    "a dim room under a bright sky": Case(
        lambda: small_room(
            walls=box(2) | grey(0.9),
            lamp=lamp(z=1.9, power=1e-6),
            sky={"type": "constant", "radiance": 100.0},
            street=look(origin=(0, -8, 4), target=(0, 0, 0)),
        ),
        enclosed(1e-6, 0.9),
    ),
    "64 lamps": Case(many_lamps, ROOM),
    "a textured lamp": Case(textured_lamp, ROOM),
    "light through glass": Case(lambda: behind("thindielectric"), enclosed(1, 0.7), spp=64),
    "light through a mask": Case(
        lambda: behind("mask", opacity=0.5, inner=grey(0.5)["bsdf"]), enclosed(1, 0.7), spp=64
    ),
    "light through nothing": Case(lambda: behind("null"), enclosed(1, 0.7), spp=64),
    "hidden lamps": Case(small_room, ROOM, settings={"hide_emitters": True}),
    "hidden sky": Case(small_open, enclosed(1, 0.7), settings={"hide_emitters": True}),
    "hidden sky behind a pane": Case(
        lambda: small_open(
            ball=ball(0, -0.5, 0.2, 0.5) | of("thindielectric"),
            sensor=look(target=(0, 0.5, 0)) | {"film": film(WIDTH, HEIGHT, pixel_format="rgba")},
        ),
        enclosed(1, 0.7),
        settings={"hide_emitters": True},
        spp=64,
    ),
    "a lamp seen from behind": Case(
        lambda: small_room(sensor=look(origin=(0, 0, 1.98), target=(0, 0.1, 0))), ROOM
    ),
}

# ---------------------- Materials ----------------------

MATERIALS = {
    "one-sided, hit from behind": Case(
        lambda: small_room(
            leaf={"type": "rectangle", "to_world": at(0, -0.4, -1.2) @ scaled(0.5)} | grey(0.6),
            sensor=look(origin=(0, -1.8, -1.6)),
        ),
        ROOM,
    ),
    "albedo 0 and 1": Case(
        lambda: small_room(
            block=block(*BLOCK, 0.4) | grey(1), ball=ball(0.6, 0, -1.4, 0.4) | grey(0)
        ),
        enclosed(LAMP, 0.9),
    ),
    "almost white": Case(
        lambda: small_room(
            walls=box(2) | grey(0.98),
            block=block(*BLOCK, 0.4) | grey(0.98),
            ball=ball(0.4, 0.2, -1.6, 0.4) | grey(0.98),
        ),
        enclosed(LAMP, 0.98),
        spp=64,
    ),
    "all black": Case(lambda: small_room(walls=box(2) | grey(0), block=None, ball=None), LAMP),
    "textures of 0 and 1": Case(
        lambda: with_ball("diffuse", reflectance=checkers()), enclosed(LAMP, 0.9)
    ),
    "mirror that shines": Case(lambda: with_ball("conductor", radiance=1.0), ROOM),
    "glass that shines": Case(lambda: with_ball("dielectric", radiance=1.0), ROOM),
    "a pane that shines before a black sky": Case(
        lambda: small_open(
            sky=BLACK_SKY,
            ball=ball(0, -0.5, 0.2, 0.5) | of("thindielectric") | emitting(1),
            sensor=look(target=(0, 0.5, 0)),
        ),
        enclosed(1, 0.7),
        spp=64,
    ),
    "mirror": Case(lambda: with_ball("conductor"), ROOM, precision=0.03),
    "metal of roughness 0.001": Case(
        lambda: with_ball("roughconductor", alpha=0.001), ROOM, precision=0.03
    ),
    "metal of roughness 1": Case(lambda: with_ball("roughconductor", alpha=1.0), ROOM),
    "glass": Case(lambda: with_ball("dielectric"), ROOM),
    "glass of roughness 0.001": Case(lambda: with_ball("roughdielectric", alpha=0.001), ROOM),
    "glass of roughness 1": Case(lambda: with_ball("roughdielectric", alpha=1.0), ROOM),
    "plastic of roughness 0.001": Case(lambda: with_ball("roughplastic", alpha=0.001), ROOM),
    "plastic of roughness 1": Case(lambda: with_ball("roughplastic", alpha=1.0), ROOM),
    "principled": Case(
        lambda: with_ball("principled", roughness=0.3, metallic=0.5, specular=0.5, clearcoat=1.0),
        ROOM,
    ),
    "principled, let through": Case(
        lambda: with_ball("principled", roughness=0.1, spec_trans=0.9), ROOM
    ),
    "blend of glass and diffuse": Case(
        lambda: with_ball("blendbsdf", weight=0.5, a={"type": "dielectric"}, b=grey(0.5)["bsdf"]),
        ROOM,
    ),
    "normal map": Case(lambda: bumped("normalmap"), ROOM),
    "bump map": Case(lambda: bumped("bumpmap"), ROOM),
    "mask and nothing": Case(leaf, ROOM),
    "a room of mirrors": Case(
        lambda: mirrored(**of("roughconductor", alpha=0.1)), enclosed(LAMP, 0.95), precision=0.05
    ),
}

# ---------------------- Sensors, films, samples ----------------------

VIEWS = {
    "film of one pixel": Case(lambda: small_room(sensor=camera(1, 1)), ROOM, spp=1024),
    "film 4096 wide": Case(lambda: small_room(sensor=camera(4096, 2)), ROOM, spp=4),
    "crop window": Case(
        lambda: filmed(crop_offset_x=5, crop_offset_y=3, crop_width=13, crop_height=11), ROOM
    ),
    "7 samples": Case(
        lambda: small_room(sensor=look()), ROOM, spp=7, own={"sampler": "independent"}
    ),
    "1 sample": Case(small_room, ROOM, spp=1, precision=0.05),
    "samples that make no grid": Case(small_room, ROOM, spp=7, warnings=1),
    "second sensor": Case(two_sensors, ROOM, sensor=1),
    "wide reconstruction filter": Case(lambda: filmed(rfilter={"type": "gaussian"}), ROOM),
    "film with alpha": Case(lambda: filmed(pixel_format="rgba"), ROOM),
    "thin lens": Case(
        lambda: small_room(sensor=look(type="thinlens", aperture_radius=0.1, focus_distance=2.0)),
        ROOM,
    ),
    "near clipping": Case(lambda: small_room(sensor=look(near_clip=2.2)), ROOM),
    "camera in glass": Case(
        lambda: small_room(
            pane=ball(0, -1.8, 0.4, 0.15) | of("dielectric"), sensor=look(near_clip=1e-3)
        ),
        1.5**2 * ROOM,
    ),
    "camera that sees nothing": Case(
        lambda: small_open(sky=None, lamp=lamp(z=1.9), sensor=look(target=(0, -3, 1))), 0.0
    ),
}

# ---------------------- What can't be rendered ----------------------

ERRORS = {
    "no surfaces": Case(
        lambda: {"type": "scene", "sensor": look(), "sky": SKY}, error="the scene has no surfaces"
    ),
    "empty mesh": Case(empty_mesh, error='shape "nothing" is a mesh without faces; remove it'),
    "scattering medium": Case(
        lambda: small_room(ball=ball(0, 0, 0, 0.5) | of("null") | {"interior": fog()}),
        error='shape "ball" has a participating medium',
    ),
    "camera in a medium": Case(
        lambda: small_room(sensor=look() | {"medium": fog()}),
        error='sensor "sensor" lies in a participating medium',
    ),
    "limit of depth": Case(small_room, own={"max_depth": 4}, error="max_depth"),
    "misspelt parameter": Case(small_room, own={"patchs": 1024}, error="patchs"),
    "parameter out of range": Case(
        small_room, own={"patches": 1}, error='"patches" must be at least 16'
    ),
    "parameter of another type": Case(
        small_room, own={"shadow_samples": "many"}, error='"shadow_samples" must be an integer'
    ),
    "missing cache file": Case(
        small_room, own={"cache_file": "none.exr"}, error="none.exr: no such file"
    ),
}

CASES: dict[str, Case] = {**CUBES, **GEOMETRY, **LIGHT, **MATERIALS, **VIEWS, **ERRORS}
"""All of them."""
