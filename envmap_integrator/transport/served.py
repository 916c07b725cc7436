"""Where the secondary rays of camera hits are served."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..lookup.lookup import Lookup
from ..system.jit import SpareNumbers
from .camera import leave
from .ending import serve
from .far import look_up_far, near_alone
from .path import trace_near
from .rules import PathRules
from .state import Path
from .vertex import Vertex


def served(
    scene: mi.Scene, lookup: Lookup, rules: PathRules, sampler: mi.Sampler, vertex: Vertex
) -> tuple[mi.Float, mi.Float, mi.Float, mi.Float]:
    """Whether a secondary ray from ``vertex`` is traced on, ends in the cache or in a map.

    Three numbers of which at most one is 1; none where the ray leaves the scene. The fourth is 1
    where it's traced on since what it hits is too near for the cache. It is a ray of its
    own, as others are sent, so that their paths, and the picture, don't depend on whether anybody
    wants to know.
    """
    start, scattered = leave(lookup, sampler, vertex, sampler.next_1d(), vertex.hit)
    path = Path.begin(start, rules, vertex.hit & (dr.max(scattered.weight) > 0))
    spare, estimates = SpareNumbers(sampler.next_1d()), mi.Bool(False)
    si = trace_near(scene, rules, start, path)
    if lookup.far_field is None:
        met = near_alone(path, si)
    else:
        met = look_up_far(scene, lookup.far_field, path, si, estimates, spare)
    end = Vertex.met(lookup, met.si, path.ray, path.active & ~met.mapped)
    in_cache = end.hit & ~met.retraced
    service = serve(lookup, rules, start, path, end, estimates, spare)
    in_cache &= service.served
    traced_on = met.retraced | (end.hit & ~in_cache)
    near = traced_on & ~met.retraced & service.near
    return tuple(dr.select(x, mi.Float(1), 0) for x in (traced_on, in_cache, met.mapped, near))
