"""How objects of a scene behave, where their parameters don't show all that they depend on.

A normal map that doesn't flip, a texture that is clamped instead of repeated: neither can be seen
in ``mi.traverse``, nor in what the object prints. Each is looked at with fixed places and
directions, which are in no way special, and so are plugins that nobody here knows.
"""

from __future__ import annotations

from collections.abc import Callable

import drjit as dr
import mitsuba as mi
import numpy as np

from .jit import R1, upload
from .spectrum import wavelengths_at

#: Number of places. Coordinates on surfaces lie inside the unit square in the first half of them.
PLACES = 1024
#: Classes whose parameters, flags and prints tell all that light depends on.
SHOWN = {
    # ---- Materials ----
    *("BlendBSDF", "CircularPolarizer", "Hair", "LinearPolarizer", "LinearRetarder", "MaskBSDF"),
    *("Null", "PolarizedPlastic", "Principled", "PrincipledThin", "RoughConductor"),
    *("RoughDielectric", "RoughPlastic", "SmoothConductor", "SmoothDielectric", "SmoothDiffuse"),
    *("SmoothPlastic", "ThinDielectric", "TwoSidedBRDF"),
    # ---- Emitters ----
    *("AreaLight", "ConstantBackgroundEmitter", "DirectionalArea", "DirectionalEmitter"),
    *("PointLight", "SpotLight"),
    # ---- Textures ----
    *("BlackBodySpectrum", "Checkerboard", "ConstVolume", "IrregularSpectrum", "MeshAttribute"),
    *("RawConstantTexture", "RawConstantTextureImpl", "RegularSpectrum"),
    *("SRGBReflectanceSpectrum", "UniformSpectrum", "VolumeAdapter"),
    # ---- Shapes, besides meshes ----
    *("BSplineCurve", "Cylinder", "Disk", "Instance", "LinearCurve", "ShapeGroupPlugin", "Sphere"),
}


def behaviour(item: mi.Object) -> list:
    """What an object does at fixed places, as Dr.Jit arrays; nothing if it hides nothing.

    Values are what they are to the last bit in each process that has as many threads.
    """
    if item.class_name() in SHOWN or isinstance(item, mi.Mesh):
        return []
    probe = next((probe for kind, probe in _probes() if isinstance(item, kind)), None)
    if probe is None:
        return []
    try:
        with dr.suspend_grad():
            results = probe(item, np.random.default_rng(seed=0))
            dr.eval(results)
    except Exception:  # Plugins of others may stop at places like these with any error.
        return []
    return results


def _probes() -> list[tuple[type, Callable]]:
    return [
        (mi.BSDF, _reflected),
        (mi.Emitter, _emitted),
        (mi.Texture, lambda texture, rng: [mi.Spectrum(texture.eval(_interaction(rng)))]),
        (mi.Volume, _in_volume),
        (mi.Shape, _surface),
    ]


def _reflected(bsdf: mi.BSDF, rng: np.random.Generator) -> list:
    si, context = _interaction(rng), mi.BSDFContext()
    # Plugins in Python may return plain numbers.
    results = [mi.Spectrum(bsdf.eval(context, si, _directions(rng)))]
    if bsdf.flags() & int(mi.BSDFFlags.Delta):
        u, v, w = _uniform(rng, 3)
        results.append(mi.Vector3f(bsdf.sample(context, si, u, mi.Point2f(v, w))[0].wo))
    return results


def _emitted(emitter: mi.Emitter, rng: np.random.Generator) -> list:
    si = _interaction(rng)
    results = [mi.Spectrum(emitter.eval(si))]
    if emitter.flags() & int(mi.EmitterFlags.Delta):
        # Some places have to lie in the light of a projector, which shines along its z axis.
        si.p = emitter.world_transform() @ (si.p + mi.Point3f(0, 0, 2))
        _, weight = emitter.sample_direction(si, mi.Point2f(*_uniform(rng, 2)))
        results.append(mi.Spectrum(weight))
    return results


def _in_volume(volume: mi.Volume, rng: np.random.Generator) -> list:
    si, box = _interaction(rng), volume.bbox()
    si.p = mi.Point3f(box.min) + si.p * mi.Vector3f(box.extents())
    return [volume.eval(si)]


def _surface(shape: mi.Shape, rng: np.random.Generator) -> list:
    """What a ray would find that had met a shape there, it doesn't matter how."""
    box, direction = shape.bbox(), _directions(rng)
    p = mi.Point3f(box.min) + mi.Vector3f(*_uniform(rng, 3)) * mi.Vector3f(box.extents())
    pi = dr.zeros(mi.PreliminaryIntersection3f, PLACES)
    pi.t = dr.norm(mi.Vector3f(box.extents()))
    u, v, w = _uniform(rng, 3)
    pi.prim_uv = mi.Point2f(u, v)
    pi.prim_index = mi.UInt32(w * max(shape.primitive_count(), 1))
    ray = mi.Ray3f(p - pi.t * direction, direction)
    si = shape.compute_surface_interaction(ray, pi)
    return [si.n, si.sh_frame.n, si.uv]


# ---------------------- Places ----------------------


def _uniform(rng: np.random.Generator, n: int) -> list[mi.Float]:
    """Numbers in [0, 1), ``n`` for each place."""
    return [upload(mi.Float, rng.random(PLACES, dtype=np.float32)) for _ in range(n)]


def _directions(rng: np.random.Generator) -> mi.Vector3f:
    """Unit vectors, many of them nearly at right angles to the z axis: there little tilts show."""
    u, v = _uniform(rng, 2)
    z = dr.mulsign(dr.square(2 * u - 1), 2 * u - 1)
    sin, cos = dr.sincos(dr.two_pi * v)
    r = dr.safe_sqrt(1 - z * z)
    return mi.Vector3f(r * cos, r * sin, z)


def _interaction(rng: np.random.Generator) -> mi.SurfaceInteraction3f:
    """Places on surfaces across the z axis, up to one unit outside of the unit cube."""
    si = dr.zeros(mi.SurfaceInteraction3f, PLACES)
    si.t, (si.time,) = mi.Float(1), _uniform(rng, 1)
    si.p = 3 * mi.Point3f(*_uniform(rng, 3)) - 1
    outside = dr.arange(mi.UInt32, PLACES) >= PLACES // 2
    uv = mi.Point2f(*_uniform(rng, 2))
    si.uv = dr.select(outside, 3 * uv - 1, uv)
    si.n, si.sh_frame = mi.Normal3f(0, 0, 1), mi.Frame3f(mi.Normal3f(0, 0, 1))
    si.dp_du, si.dp_dv = mi.Vector3f(1, 0, 0), mi.Vector3f(0, 1, 0)
    si.wi = _directions(rng)
    si.wavelengths = wavelengths_at(mi.Float(dr.arange(mi.UInt32, PLACES)) * R1)
    return si
