"""Surfaces that paths meet."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..lookup.far_field import Cube
from ..lookup.lookup import Lookup
from ..lookup.patches import Cell
from ..system.ray_counts import Ray, count
from .lobes import Lobes


@dataclass
class Vertex:
    """A surface that a path meets, and what is looked up of its place.

    si, bsdf           the surface
    hit                whether there is one,
    smooth             ... and whether it reflects light from emitters
    normal, object_id  geometric normal on the side that was hit, and id of the shape
    cell               large cell of the coarse mesh
    emitter_row        of the choice among emitters there
    cube               bounds secondary rays from it; None without maps
    lobes              of its material
    """

    si: mi.SurfaceInteraction3f
    bsdf: mi.BSDFPtr
    hit: mi.Bool
    smooth: mi.Bool
    normal: mi.Normal3f
    object_id: mi.UInt32
    cell: Cell
    emitter_row: mi.UInt32
    cube: Cube | None
    lobes: Lobes

    @staticmethod
    def met(lookup: Lookup, si: mi.SurfaceInteraction3f, ray: mi.Ray3f, active: mi.Bool) -> Vertex:
        """What a ray has met."""
        far_field = lookup.far_field
        bsdf, hit = si.bsdf(ray), active & si.is_valid()
        smooth = hit & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
        mapped = hit if far_field is not None and far_field.map_mirrors else smooth
        normal = dr.mulsign(si.n, -dr.dot(si.n, ray.d))
        object_id = lookup.object_ids(si)
        cell = lookup.patches.locate(si.p, normal, object_id, mapped)
        row = lookup.emitters.row(cell.index, cell.found)
        cube = None if far_field is None else far_field.cube(cell.index, si.p, cell.found)
        lobes = Lobes.of(bsdf, si, hit)
        return Vertex(si, bsdf, hit, smooth, normal, object_id, cell, row, cube, lobes)


@dr.syntax
def skip_emitters(
    scene: mi.Scene, ray: mi.Ray3f, pi: mi.PreliminaryIntersection3f, active: mi.Bool
) -> mi.PreliminaryIntersection3f:
    """Where an intersection lies on an area emitter, look behind it (``hide_emitters``)."""
    ray = mi.Ray3f(ray)
    pi = mi.PreliminaryIntersection3f(pi)
    active = active & pi.is_valid() & (pi.shape.emitter() != None)  # noqa: E711
    while dr.hint(active, label="Skip hidden emitters"):
        si = pi.compute_surface_interaction(ray, mi.RayFlags.Minimal, active)
        behind = si.spawn_ray(ray.d)
        ray = dr.select(active, behind, ray)
        count(Ray.PRIMARY, ray, active)
        pi_behind = scene.ray_intersect_preliminary(ray, coherent=True, active=active)
        pi = dr.select(active, pi_behind, pi)
        active &= pi.is_valid() & (pi.shape.emitter() != None)  # noqa: E711
    return pi
