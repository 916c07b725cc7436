"""Intel's Open Image Denoise, guided by albedo and normals, after any integrator."""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from .film import INDIRECT_AOVS

GUIDE_SPP = 16
"""At most so many samples per pixel for albedo and normals, which have little noise."""

DARK = 1 / 32
"""What reflects less than this part of the mean keeps its light: its irradiance, a little light
over next to nothing, as of a metal that is hardly diffuse, would shine over all around."""


def prepare_for_denoiser(integrator: mi.Integrator) -> bool:
    """Have an integrator give the AOVs that help ``denoise``.

    Returns whether all AOVs are to be taken off the picture afterwards: nobody asked for any.
    """
    if getattr(integrator, "indirect_aovs", None) is not False:
        return False
    unasked = not integrator.aov_names()
    integrator.indirect_aovs = True
    return unasked


def denoise(
    scene: mi.Scene,
    integrator: mi.Integrator,
    picture: np.ndarray,
    spp: int,
    seed: int,
    sensor: mi.Sensor | int = 0,
) -> np.ndarray:
    """The denoised picture of a sensor, [H, W, 3]; the guides are rendered here.

    ``picture`` holds all channels that the integrator has rendered. Where the last of them are
    ``INDIRECT_AOVS``, direct light and irradiance, which is free of textures, are denoised apart:
    each has noise and edges of its own.

    The sensor's film is left with the guides. Raises ``ImportError`` if the optional package
    mitsuba-oidn is missing.
    """
    guide = mi.load_dict({"type": "aov", "aovs": "albedo:albedo,normal:sh_normal"})
    rendered = mi.render(scene, integrator=guide, sensor=sensor, spp=min(spp, GUIDE_SPP), seed=seed)
    channels = np.array(rendered, dtype=np.float32)
    albedo, normal = np.clip(channels[:, :, -6:-3], 0, 1), channels[:, :, -3:]
    colour = picture[:, :, :3]
    n_aovs = len(INDIRECT_AOVS)
    if integrator.aov_names()[-n_aovs:] != list(INDIRECT_AOVS):
        return _filter(colour, albedo, normal)
    indirect, gathered, reflectance = np.split(picture[:, :, -n_aovs:], 3, axis=2)
    lit = reflectance > DARK * reflectance.mean()
    usual = gathered.sum(axis=(0, 1)) / np.maximum(reflectance.sum(axis=(0, 1)), 1e-30)
    irradiance = np.where(lit, gathered / np.where(lit, reflectance, 1), usual)
    irradiance = _filter(irradiance, np.ones_like(albedo), normal)
    rest = colour - indirect + np.where(lit, 0, gathered)
    return _filter(rest, albedo, normal) + np.where(lit, reflectance * irradiance, 0)


def warm_up(width: int, height: int) -> None:
    """Have the denoiser set itself up for pictures of this size, which takes it a while."""
    blank = np.zeros((height, width, 3))
    _filter(blank, blank, blank)


def _filter(picture: np.ndarray, albedo: np.ndarray, normal: np.ndarray) -> np.ndarray:
    try:
        import mitsuba_oidn
    except ImportError:
        raise ImportError("the denoiser is missing: pip install mitsuba-oidn") from None
    picture, albedo, normal = (
        np.ascontiguousarray(image, dtype=np.float32) for image in (picture, albedo, normal)
    )
    return mitsuba_oidn.denoise(picture, albedo=albedo, normal=normal, hdr=True)
