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
from compare.scene_kit import (  # noqa: F401  (tests have them from here)
    Description,
    at,
    ball,
    block,
    box,
    camera,
    cluster,
    colour,
    emitting,
    film,
    grey,
    lamp,
    open_scene,
    room,
    scaled,
)

ROOT = Path(__file__).parents[1]
SCENES = ROOT / "scenes"

#: Half width of a confidence interval in standard errors: 1 in 15,000 of true ones is missed.
QUANTILE = 4.0
#: Patches that suffice for a small room.
PATCHES = 2048

# ---------------------- Scenes ----------------------


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
