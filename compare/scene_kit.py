"""Parts of small scenes, as ``mi.load_dict`` takes them."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

Description = dict[str, Any]

BLACK_SKY = {"type": "constant", "radiance": {"type": "rgb", "value": 0}, "sampling_weight": 0.0}
"""Lights nothing and gets no shadow rays, but is there: without any sky, ``path`` drops all light
of a path that meets nothing solid, also what a luminous pane of glass emits."""


def room(**changes: Any) -> Description:
    """A closed grey room, 4 wide, with a lamp under its ceiling, a block and a ball on the floor.

    ``changes`` add to its parts or replace them; None removes a part.
    """
    parts = {
        "type": "scene",
        "sensor": camera(),
        "walls": box(2.0) | grey(0.5),
        "lamp": lamp(z=1.9),
        "block": block(-0.5, 0.6, -1.5, 0.4) | grey(0.7),
        "ball": ball(0.4, 0.2, -1.6, 0.4) | grey(0.6, 0.3, 0.2),
    } | changes
    return {name: part for name, part in parts.items() if part is not None}


def open_scene(**changes: Any) -> Description:
    """The block and the ball on a large floor under the open sky."""
    floor = {"type": "rectangle", "to_world": at(0, 0, -2) @ scaled(6)} | grey(0.5)
    return room(**{"walls": None, "lamp": None, "floor": floor} | changes)


def camera(
    width: int = 32, height: int = 24, origin=(0, -1.8, 0.4), target=(0, 0.5, -1), **more: Any
) -> Description:
    """A sensor whose pixels are independent of each other, as the statistics below ask for."""
    return {
        "type": "perspective",
        "fov": 80,
        "near_clip": 1e-6 * max(map(abs, origin)),
        "far_clip": 1e7,
        "to_world": mi.ScalarTransform4f().look_at(origin, target, up=[0, 0, 1]),
        "sampler": {"type": "independent"},
        "film": film(width, height),
    } | more


def film(width: int, height: int, **more: Any) -> Description:
    return {
        "type": "hdrfilm",
        "width": width,
        "height": height,
        "rfilter": {"type": "box"},
        "pixel_format": "rgb",
    } | more


def box(half_width: float) -> Description:
    """A closed box seen from inside."""
    return {"type": "cube", "to_world": scaled(half_width), "flip_normals": True}


def block(x: float, y: float, z: float, half_width: float) -> Description:
    return {"type": "cube", "to_world": at(x, y, z) @ scaled(half_width)}


def ball(x: float, y: float, z: float, radius: float) -> Description:
    return {"type": "sphere", "center": [x, y, z], "radius": radius}


def lamp(x: float = 0, y: float = 0, z: float = 0, half_width: float = 0.5, power: float = 10):
    """A black square that shines downwards."""
    turned = mi.ScalarTransform4f().rotate([1, 0, 0], 180)
    shape = {"type": "rectangle", "to_world": at(x, y, z) @ turned @ scaled(half_width)}
    return shape | grey(0) | emitting(power)


def grey(*reflectance: float) -> Description:
    """A diffuse material: a grey, or red, green, blue."""
    return {"bsdf": {"type": "diffuse", "reflectance": colour(*reflectance)}}


def emitting(*radiance: float) -> Description:
    return {"emitter": {"type": "area", "radiance": colour(*radiance)}}


def colour(*value: float) -> Description:
    return {"type": "rgb", "value": list(value) if len(value) > 1 else value[0]}


def at(x: float, y: float, z: float) -> mi.ScalarTransform4f:
    return mi.ScalarTransform4f().translate([x, y, z])


def scaled(factor: float) -> mi.ScalarTransform4f:
    return mi.ScalarTransform4f().scale(factor)


def cluster(*shapes: str, distance_ratio: float = 1.5) -> Description:
    """A nested ``mipmap_cube`` that asks for a cluster."""
    names = ", ".join(shapes or ("block", "ball"))
    return {"type": "mipmap_cube", "shapes": names, "distance_ratio": distance_ratio}


PLACEABLE = ("cube", "rectangle", "sphere", "disk", "cylinder")
"""Plugins that ``placed`` moves."""


def placed(scene: Description, scale: float = 1.0, offset=(0.0, 0.0, 0.0)) -> Description:
    """The scene, scaled about the origin and then moved by ``offset``, as its cameras saw it."""
    transform = at(*offset) @ scaled(scale)
    moved = dict(scene)
    for name, part in scene.items():
        kind = part["type"] if isinstance(part, dict) else ""
        if kind in PLACEABLE:
            moved[name] = part | {"to_world": transform @ part.get("to_world", scaled(1))}
        elif kind == "perspective":
            pose = np.array(part["to_world"].matrix)
            origin, along, up = pose[:3, 3], pose[:3, 2], pose[:3, 1].tolist()
            origin, target = (
                (scale * point + offset).tolist() for point in (origin, origin + along)
            )
            to_world = mi.ScalarTransform4f().look_at(origin, target, up)
            near = scale * part["near_clip"]
            moved[name] = part | {"to_world": to_world, "near_clip": near, "far_clip": 1e7 * scale}
    return moved


# ---------------------- Shapes made of numbers ----------------------


def mesh(vertices, faces, normals=None, **properties: Any) -> mi.Mesh:
    """Triangles ``faces`` [F, 3] between ``vertices`` [V, 3]; ``properties`` are objects."""
    vertices, faces = np.asarray(vertices, np.float32), np.asarray(faces, np.uint32)
    props = mi.Properties()
    for name, description in properties.items():
        props[name] = mi.load_dict(description)
    shape = mi.Mesh("mesh", len(vertices), len(faces), props, normals is not None)
    values = mi.traverse(shape)
    values["vertex_positions"] = vertices.ravel()
    values["faces"] = faces.ravel()
    if normals is not None:
        values["vertex_normals"] = np.asarray(normals, np.float32).ravel()
    values.update()
    return shape


def curve(kind: str, points, radius: float, **parts: Any) -> mi.Object:
    """A ``linearcurve`` or ``bsplinecurve`` through ``points`` [N, 3]."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "curve.txt"
        path.write_text("".join(f"{x} {y} {z} {radius}\n" for x, y, z in points))
        return mi.load_dict({"type": kind, "filename": str(path), **parts})


def texture(texels, raw: bool = False) -> Description:
    """A bitmap of ``texels`` [H, W, 3], not filtered."""
    bitmap = mi.Bitmap(np.asarray(texels, np.float32))
    return {"type": "bitmap", "bitmap": bitmap, "raw": raw, "filter_type": "nearest"}


def checkers(low: float = 0.0, high: float = 1.0) -> Description:
    """Squares of two greys."""
    return texture(np.where(np.indices((8, 8)).sum(axis=0) % 2, high, low)[..., None].repeat(3, 2))
