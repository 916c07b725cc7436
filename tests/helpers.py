"""Scenes, pictures and statistics that the system and regression tests share."""

from __future__ import annotations

import os
import resource
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

import envmap_integrator  # noqa: F401  (registers the plugins)

ROOT = Path(__file__).parents[1]
SCENES = ROOT / "scenes"

#: Half width of a confidence interval in standard errors: 1 in 15,000 of true ones is missed.
QUANTILE = 4.0
#: Patches that suffice for a small room.
PATCHES = 2048

Description = dict[str, Any]

# ---------------------- Scenes ----------------------


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


@contextmanager
def unprivileged() -> Iterator[None]:
    """Without the right of the superuser to ignore permissions, if that is who runs the tests."""
    nobody = 65534
    if os.getuid() != 0:
        yield
        return
    os.setresuid(nobody, nobody, 0)
    try:
        yield
    finally:
        os.setresuid(0, 0, 0)


@contextmanager
def at_most(size: int) -> Iterator[None]:
    """No file may grow larger than ``size`` bytes, as on a disk that is full."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (int(size), limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)


def at(x: float, y: float, z: float) -> mi.ScalarTransform4f:
    return mi.ScalarTransform4f().translate([x, y, z])


def scaled(factor: float) -> mi.ScalarTransform4f:
    return mi.ScalarTransform4f().scale(factor)


def cluster(*shapes: str, distance_ratio: float = 1.5) -> Description:
    """A nested ``mipmap_cube`` that asks for a cluster."""
    names = ", ".join(shapes or ("block", "ball"))
    return {"type": "mipmap_cube", "shapes": names, "distance_ratio": distance_ratio}


def load(description: Description) -> mi.Scene:
    return mi.load_dict(description, optimize=False)


def load_scene(path: Path, width: int, height: int, **parameters: Any) -> mi.Scene:
    return mi.load_file(str(path), optimize=False, resx=width, resy=height, **parameters)


def integrator(kind: str, **settings: Any) -> mi.Integrator:
    """One of ours on a small budget, or one of Mitsuba's.

    Ours make all maps, and pixels share nothing: they are independent of each other.
    """
    own: Description = {}
    if kind in ("envmap_hybrid", "one_level_path", "source_selection", "envmap_bake"):
        own = {"patches": PATCHES, "sampler": "scene"}
    if kind in ("envmap_hybrid", "one_level_path"):
        own["irradiance_filter"] = False
    if kind == "envmap_hybrid":
        own["maps"] = "always"
    return mi.load_dict({"type": kind} | own | settings)


# ---------------------- Pictures and statistics ----------------------


@dataclass(frozen=True)
class Estimate:
    """Means over independent renders, and the variance of those means.

    mean, variance   [H, W] per pixel or tile, [] of a whole picture; grey
    """

    mean: np.ndarray
    variance: np.ndarray

    def tiles(self, size: int) -> Estimate:
        """Averages over tiles of size x size pixels; those cut by the border are left out."""
        height, width = (n // size for n in self.mean.shape)
        blocks = np.s_[: height * size, : width * size]
        mean, variance = (
            x[blocks].reshape(height, size, width, size).mean(axis=(1, 3))
            for x in (self.mean, self.variance)
        )
        return Estimate(mean, variance / size**2)

    def at(self, index: tuple[int, int]) -> Estimate:
        """A single pixel or tile."""
        return Estimate(self.mean[index], self.variance[index])

    def overall(self) -> Estimate:
        return Estimate(self.mean.mean(), self.variance.mean() / self.mean.size)


def picture(
    scene: mi.Scene, integrator: mi.Integrator, spp: int = 16, seed: int = 0, sensor: int = 0
) -> np.ndarray:
    """A picture [H, W, C], all its pixels finite and not negative."""
    pixels = np.array(mi.render(scene, integrator=integrator, spp=spp, seed=seed, sensor=sensor))
    assert np.isfinite(pixels).all()
    assert (pixels >= 0).all()
    return pixels


def measure(scene: mi.Scene, integrator: mi.Integrator, spp: int = 64, seeds: int = 4) -> Estimate:
    """Mean and variance of a scene's pixels, from renders with different seeds."""
    pictures = np.stack(
        [picture(scene, integrator, spp, seed).mean(axis=-1) for seed in range(seeds)]
    ).astype(np.float64)
    return Estimate(pictures.mean(axis=0), pictures.var(axis=0, ddof=1) / seeds)


def exactly(value: float) -> Estimate:
    """A known result."""
    return Estimate(np.float64(value), np.float64(0))


def assert_agree(
    ours: Estimate, reference: Estimate, allowed: float = 0.0, precision: float = 0.01
) -> None:
    """Both means are the same, as far as their noise tells, to the relative error ``allowed``.

    ``precision`` is the largest relative half width of a confidence interval with which the
    comparison means anything.
    """
    bias = ours.mean / reference.mean - 1
    half_width = QUANTILE * np.sqrt(ours.variance + reference.variance) / reference.mean
    worst = np.unravel_index(np.argmax(np.abs(bias) - half_width), bias.shape)
    assert np.all(half_width <= precision), f"too noisy: ± {half_width.max():.2%}"
    assert np.all(np.abs(bias) <= allowed + half_width), (
        f"off by {bias[worst]:+.2%} ± {half_width[worst]:.2%} at {worst}, {allowed:.2%} allowed"
    )
