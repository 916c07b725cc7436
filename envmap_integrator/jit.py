"""Small helpers around Dr.Jit."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi


def opaque_point(values) -> mi.Point3f:
    """A point that kernels read as data: changing it compiles nothing."""
    point = mi.Point3f(*(float(value) for value in values))
    dr.make_opaque(point)
    return point
