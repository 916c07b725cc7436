"""From where light has to come for a material to reflect it where cached irradiance stands for it.

The cache has one irradiance for all directions that a surface is looked at from. As light passes
the coat of a varnish less at grazing angles, and rough gloss reflects more there, a lamp counts
more or less by where it hangs. With a(w) the part of the light from w that a material reflects by
the lobes that the cache serves, a(v) a(w) / (π ā) stands for their BSDF: as much of the light from
any direction is reflected, and as much is seen from any, as there really is.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ...system.jit import R2, mean_channel, upload
from ...system.spectrum import wavelengths_at
from ...transport.lobes import Lobes, is_diffuse, single_lobe
from ..coarse_mesh.surface_points import SurfacePoints

#: Steps of the squared cosine, all of which as much of an even illumination comes from.
STEPS = 32
#: Directions sampled for each material and step, and for all of them together.
SAMPLES, ALL_SAMPLES = 1024, 1 << 22


class Incidence:
    """How much light from a direction counts at surface points: a(w) / ā."""

    def __init__(self, points: SurfacePoints):
        used = np.bincount(points.material) > 0  # Ids are small: no need to sort them.
        self._row = upload(mi.UInt32, (np.cumsum(used) - 1)[points.material])
        self._table = upload(mi.Float, _table(np.flatnonzero(used)))

    def __call__(self, point: mi.UInt32, cosine: mi.Float) -> mi.Float:
        """Factor [1] for light that arrives at ``cosine`` to the shading normal of a point."""
        row = dr.gather(mi.UInt32, self._row, point)
        step = dr.minimum(mi.UInt32(dr.square(cosine) * STEPS), STEPS - 1)
        return dr.gather(mi.Float, self._table, row * STEPS + step)


def _table(materials: np.ndarray) -> np.ndarray:
    """a(w) / ā [M, STEPS] of M materials; 1 for diffuse ones, and where that can't be told."""
    bsdf = dr.reinterpret_array(mi.BSDFPtr, upload(mi.UInt32, materials // 2))
    several = (is_diffuse(bsdf) & ~single_lobe(bsdf)).numpy()
    table = np.ones((len(materials), STEPS))
    if several.any():
        reflected = _reflected(materials[several])
        mean = reflected.mean(axis=1, keepdims=True)
        table[several] = np.where(mean > 0, reflected / np.maximum(mean, 1e-30), 1)
    return table


def _reflected(materials: np.ndarray) -> np.ndarray:
    """a(w) [M, STEPS] of M materials, but for a factor."""
    samples = min(max(ALL_SAMPLES // max(STEPS * len(materials), 1), 1), SAMPLES)
    samples = 1 << int(np.log2(samples))
    lane = dr.arange(mi.UInt32, len(materials) * STEPS * samples)
    samples_ = dr.opaque(mi.UInt32, samples)
    k, step, row = lane % samples_, lane // samples_ % STEPS, lane // (samples_ * STEPS)

    # ---- A surface of each material, lit from a direction of each step ----
    material = dr.gather(mi.UInt32, upload(mi.UInt32, materials), row)
    bsdf = dr.reinterpret_array(mi.BSDFPtr, material // 2)
    u, v = (mi.Float(k) * r - dr.floor(mi.Float(k) * r) for r in R2)
    cosine = dr.sqrt((mi.Float(step) + u) / STEPS)
    sine, azimuth = dr.safe_sqrt(1 - dr.square(cosine)), dr.two_pi * mi.radical_inverse_2(k, 0)
    si = dr.zeros(mi.SurfaceInteraction3f, len(materials) * STEPS * samples)
    si.n, si.sh_frame = mi.Normal3f(0, 0, 1), mi.Frame3f(mi.Normal3f(0, 0, 1))
    si.dp_du, si.dp_dv = mi.Vector3f(1, 0, 0), mi.Vector3f(0, 1, 0)
    si.uv, si.wavelengths = mi.Point2f(v, u), wavelengths_at(u)
    side = dr.select(material % 2 == 0, mi.Float(1), -1)
    w = mi.Vector3f(sine * dr.cos(azimuth), sine * dr.sin(azimuth), side * cosine)
    place = mi.Point2f((mi.Float(k) + 0.5) / mi.Float(samples_), mi.radical_inverse_2(k, 1))
    si.wi = side * mi.warp.square_to_cosine_hemisphere(place)

    # ---- What it reflects, to where it's looked at from ----
    value = bsdf.eval(mi.BSDFContext(), si, w)
    reflected = mean_channel(Lobes.of(bsdf, si, True).wide_share(w, value) * value) / cosine
    reflected = dr.block_sum(dr.select(dr.isfinite(reflected), reflected, 0), samples).numpy()
    return reflected.reshape(len(materials), STEPS).astype(np.float64)
