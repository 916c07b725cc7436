"""Intel's Open Image Denoise, guided by albedo and normals, after any integrator."""

from __future__ import annotations

import mitsuba as mi
import numpy as np

GUIDE_SPP = 16
"""At most so many samples per pixel for albedo and normals, which have little noise."""


def denoise(
    scene: mi.Scene, picture: np.ndarray, spp: int, seed: int, sensor: int = 0
) -> np.ndarray:
    """The denoised picture of a sensor, [H, W, 3]; the guides are rendered here.

    The sensor's film is left with the guides. Raises ``ImportError`` if the optional package
    mitsuba-oidn is missing.
    """
    guide = mi.load_dict({"type": "aov", "aovs": "albedo:albedo,normal:sh_normal"})
    rendered = mi.render(scene, integrator=guide, sensor=sensor, spp=min(spp, GUIDE_SPP), seed=seed)
    channels = np.array(rendered, dtype=np.float32)
    return _filter(picture, np.clip(channels[:, :, -6:-3], 0, 1), channels[:, :, -3:])


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
