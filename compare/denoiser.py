"""Intel's denoiser with Mitsuba's own guide images, the same for every integrator."""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from compare.metrics import Picture

GUIDE_SPP = 16
"""At most so many samples per pixel for albedo and normals, which have little noise."""


def denoise(scene: mi.Scene, picture: Picture, spp: int, seed: int) -> Picture:
    """The denoised picture, [H, W, 3]; the guides are rendered here.

    Raises ``ImportError`` if the optional package mitsuba-oidn is missing.
    """
    guide = mi.load_dict({"type": "aov", "aovs": "albedo:albedo,normal:sh_normal"})
    channels = np.array(
        mi.render(scene, integrator=guide, spp=min(spp, GUIDE_SPP), seed=seed), dtype=np.float32
    )
    return _filter(picture, np.clip(channels[:, :, -6:-3], 0, 1), channels[:, :, -3:])


def warm_up(width: int, height: int) -> None:
    """Have the denoiser set itself up for pictures of this size, which takes it a while."""
    blank = np.zeros((height, width, 3))
    _filter(blank, blank, blank)


def _filter(picture: Picture, albedo: Picture, normal: Picture) -> Picture:
    try:
        import mitsuba_oidn
    except ImportError:
        raise ImportError("no denoiser: pip install mitsuba-oidn") from None
    picture, albedo, normal = (
        np.ascontiguousarray(image, dtype=np.float32) for image in (picture, albedo, normal)
    )
    return mitsuba_oidn.denoise(picture, albedo=albedo, normal=normal, hdr=True)
