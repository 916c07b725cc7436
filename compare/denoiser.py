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
    try:
        import mitsuba_oidn
    except ImportError:
        raise ImportError("no denoiser: pip install 'envmap-integrator[compare]'") from None
    guide = mi.load_dict({"type": "aov", "aovs": "albedo:albedo,normal:sh_normal"})
    channels = np.array(
        mi.render(scene, integrator=guide, spp=min(spp, GUIDE_SPP), seed=seed), dtype=np.float32
    )
    return mitsuba_oidn.denoise(
        np.ascontiguousarray(picture, dtype=np.float32),
        albedo=np.ascontiguousarray(np.clip(channels[:, :, -6:-3], 0, 1)),
        normal=np.ascontiguousarray(channels[:, :, -3:]),
        hdr=True,
    )
