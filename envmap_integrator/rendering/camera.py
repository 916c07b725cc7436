"""Radiance along camera and bake rays."""

from __future__ import annotations

import mitsuba as mi

from .transport import PathEnd, PathState, Transport, follow
import drjit as dr


def camera_radiance(
    scene: mi.Scene,
    transport: Transport,
    sampler: mi.Sampler,
    ray: mi.Ray3f,
    active: mi.Bool,
    shadow_samples: int,
    secondary_samples: int,
) -> PathEnd:
    """What the light along rays from a sensor or a map is made of."""
    start = PathState(
        ray=ray,
        depth=mi.UInt32(0),
        origin=dr.zeros(mi.Interaction3f),
        pdf=mi.Float(1),
        specular=mi.Bool(True),
        bounded=mi.Bool(False),
        cluster=mi.UInt32(0),
    )
    return follow(scene, transport, sampler, start, active)
