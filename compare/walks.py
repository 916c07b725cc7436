"""What a worker that owns one cluster does with the camera hits on it, counted ray by ray.

The paths are those of ``envmap_hybrid``, followed as far as the worker can alone: it holds the
surfaces in its cluster's cube, enlarged by as much as rays go beyond it, and the cluster's map.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from enum import IntEnum
from unittest.mock import patch

import drjit as dr
import mitsuba as mi
import numpy as np

from envmap_integrator.lookup.cube import exit_distance
from envmap_integrator.lookup.far_field import HAND_OFF
from envmap_integrator.lookup.lookup import Lookup
from envmap_integrator.system.jit import SpareNumbers, upload
from envmap_integrator.system.ray_counts import Ray
from envmap_integrator.transport import direct_light
from envmap_integrator.transport.camera import follow_mirrors, leads_on, leave
from envmap_integrator.transport.direct_light import WideShare, sample_emitters
from envmap_integrator.transport.ending import end_in_cache, serve
from envmap_integrator.transport.path import direct_light as light_and_direction
from envmap_integrator.transport.path import roulette, scatter
from envmap_integrator.transport.rules import PathRules
from envmap_integrator.transport.state import Path
from envmap_integrator.transport.vertex import Vertex

HELD = 1 + 2 * HAND_OFF
"""Half width of what a worker holds over that of its cube: a ray within the cube is at most twice
as long as its half width, along each axis, and is traced so much farther."""

MAX_LANES = 1 << 22
"""Camera samples in a launch: bounds memory."""


class Event(IntEnum):
    """What is counted.

    CAMERA      camera hits, after mirrors, glass and holes
    SECONDARY   secondary rays that these send
    INSIDE      ... whose paths end among the surfaces that the worker holds
    MAP         ... in the map of the cluster
    UNCERTAIN   ... where the map isn't trusted
    NARROW      ... of mirrors and narrow lobes that leave what is held, without a map
    OTHERS      ... that go on from other surfaces in the cube and leave what is held
    SHADOW      shadow rays, at camera hits and further on
    WITHIN      ... that end within what is held
    BLOCKED     ... that would leave it, but something that is held blocks them
    PLACED      camera hits of no cluster that lie among what some worker holds
    """

    CAMERA = 0
    SECONDARY = 1
    INSIDE = 2
    MAP = 3
    UNCERTAIN = 4
    NARROW = 5
    OTHERS = 6
    SHADOW = 7
    WITHIN = 8
    BLOCKED = 9
    PLACED = 10


ENDS = (Event.INSIDE, Event.MAP, Event.UNCERTAIN, Event.NARROW, Event.OTHERS)
"""Of secondary rays: each has one."""

SENT_ON = (Event.UNCERTAIN, Event.NARROW, Event.OTHERS)
"""Secondary rays that the worker can't serve alone."""


@dataclass(frozen=True)
class Work:
    """What a picture asks of a worker.

    counts    how often each event was
    patches   of the cache that it has read
    """

    counts: dict[Event, int]
    patches: int

    def share(self, *events: Event, of: Event) -> float:
        """How many of the latter were one of the former."""
        return sum(self.counts[event] for event in events) / max(self.counts[of], 1)

    @property
    def paths_sent(self) -> int:
        """Secondary rays that it can't serve alone."""
        return sum(self.counts[event] for event in SENT_ON)

    @property
    def shadow_rays_sent(self) -> int:
        """Shadow rays of which it can't tell whether they reach their emitter."""
        counts = self.counts
        return counts[Event.SHADOW] - counts[Event.WITHIN] - counts[Event.BLOCKED]


class Tally:
    """Counts for each owner: the M clusters, then all that belongs to none.

    Nothing is beyond what the last one holds, so its paths never leave.
    """

    def __init__(self, centres: np.ndarray, half_widths: np.ndarray, n_patches: int):
        self.n_clusters, self.n_patches = len(centres), n_patches
        boxes = np.concatenate([centres, HELD * half_widths[:, None]], axis=1)
        self._boxes = upload(mi.Float, np.vstack([boxes, [0, 0, 0, np.inf]]))
        self._counts = dr.zeros(mi.UInt64, (self.n_clusters + 1) * len(Event))
        self._read = dr.zeros(mi.UInt32, (self.n_clusters + 1) * n_patches)
        dr.make_opaque(self._counts, self._read)

    def add(self, event: Event, owner: mi.UInt32, active: mi.Bool) -> None:
        """Count one of each active lane."""
        slot = owner * len(Event) + int(event)
        dr.scatter_add(self._counts, mi.UInt64(1), slot, active, dr.ReduceMode.Local)

    def read(self, owner: mi.UInt32, patch: mi.UInt32, active: mi.Bool) -> None:
        """Note that an owner reads a patch of the cache."""
        slot = owner * mi.UInt32(self.n_patches) + patch
        dr.scatter(self._read, mi.UInt32(1), slot, active, mode=dr.ReduceMode.NoConflicts)

    def exit(self, owner: mi.UInt32, ray: mi.Ray3f) -> mi.Float:
        """Distance at which a ray leaves what its owner holds; negative where it starts outside."""
        box = dr.gather(mi.Vector4f, self._boxes, owner)
        return exit_distance(mi.Point3f(box.x, box.y, box.z), box.w, ray.o, ray.d)

    def place(self, owner: mi.UInt32, p: mi.Point3f, active: mi.Bool) -> None:
        """Count the points that are some worker's though not of its cluster."""
        held = mi.Bool(False)
        for cluster in range(self.n_clusters):
            box = dr.gather(mi.Vector4f, self._boxes, mi.UInt32(cluster))
            held |= dr.all(dr.abs(p - mi.Point3f(box.x, box.y, box.z)) < box.w)
        self.add(Event.PLACED, owner, active & held & (owner == self.n_clusters))

    @contextmanager
    def shadow_rays(self, scene: mi.Scene, owner: mi.UInt32) -> Iterator[None]:
        """Count the shadow rays that are sent for each lane's owner."""

        def watch(kind, ray, active):
            if kind != Ray.SHADOW:
                return
            reach = self.exit(owner, ray)
            within = active & (ray.maxt <= reach)
            held = mi.Ray3f(ray)
            held.maxt = dr.minimum(ray.maxt, dr.maximum(reach, 0))
            leaves = active & ~within
            self.add(Event.SHADOW, owner, active)
            self.add(Event.WITHIN, owner, within)
            self.add(Event.BLOCKED, owner, leaves & scene.ray_test(held, leaves))

        with patch.object(direct_light, "count", watch):
            yield

    def counts(self) -> list[Work]:
        """Of each owner."""
        table = self._counts.numpy().reshape(-1, len(Event))
        patches = (self._read.numpy().reshape(-1, self.n_patches) > 0).sum(axis=1)
        return [
            Work({event: int(row[event]) for event in Event}, int(n))
            for row, n in zip(table, patches, strict=True)
        ]


@dataclass
class Hits:
    """Camera samples and what they hit.

    ray      the last ray, from the sensor or from a mirror on the way
    vertex   the first surface but mirrors, glass and holes
    owner    its cluster, the number of clusters if it has none
    """

    ray: mi.Ray3f
    vertex: Vertex
    owner: mi.UInt32


def camera_hits(
    scene: mi.Scene, lookup: Lookup, sampler: mi.Sampler, pixel: mi.UInt32, n_clusters: int
) -> Hits:
    """Send a ray through a random place of each of the ``pixel``s of the first sensor."""
    sensor = scene.sensors()[0]
    width, height = sensor.film().size()
    place = mi.Point2f(mi.Float(pixel % width), mi.Float(pixel // width)) + sampler.next_2d()
    place = mi.Point2f(place.x / width, place.y / height)
    time = sensor.shutter_open()
    ray, _ = sensor.sample_ray(time, 0.5, place, sampler.next_2d())
    ray = mi.Ray3f(ray)
    si = scene.ray_intersect(ray)
    mirrored = leads_on(si, ray, mi.Bool(True))
    si, ray, throughput, _, _ = follow_mirrors(scene, sampler, si, ray, mirrored)
    vertex = Vertex.met(lookup, si, ray, dr.max(throughput) > 0)
    owner = dr.select(vertex.cube.valid, vertex.cube.cluster, n_clusters)
    return Hits(ray, vertex, owner)


def count_work(
    scene: mi.Scene, lookup: Lookup, rules: PathRules, tally: Tally, spp: int, seed: int
) -> None:
    """Count what the samples of a picture by the first sensor ask of the workers."""
    width, height = scene.sensors()[0].film().size()
    n_pixels = width * height
    each = max(min(MAX_LANES // n_pixels, spp), 1)
    for first in range(0, spp, each):
        n = min(each, spp - first)
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(seed + first, n * n_pixels)
        pixel = dr.arange(mi.UInt32, n * n_pixels) % n_pixels
        hits = camera_hits(scene, lookup, sampler, pixel, tally.n_clusters)
        tally.add(Event.CAMERA, hits.owner, hits.vertex.hit)
        tally.place(hits.owner, hits.vertex.si.p, hits.vertex.hit)
        with tally.shadow_rays(scene, hits.owner):
            light = sample_emitters(
                scene,
                lookup.emitters,
                hits.vertex,
                WideShare(),
                sampler,
                mi.UInt32(rules.shadow_samples),
                hits.vertex.smooth,
            )
            light += _walk(scene, lookup, rules, sampler, hits.vertex, hits.owner, tally)
        dr.eval(light)


@dr.syntax
def _walk(
    scene: mi.Scene,
    lookup: Lookup,
    rules: PathRules,
    sampler: mi.Sampler,
    vertex: Vertex,
    owner: mi.UInt32,
    tally: Tally,
) -> mi.Spectrum:
    """Follow a secondary ray of each vertex for as long as its owner can: see ``path.follow``.

    Returns a part of the light, only so that its rays are traced.
    """
    found, no = mi.Spectrum(0), mi.Bool(False)
    start, scattered = leave(lookup, sampler, vertex, sampler.next_1d(), vertex.hit)
    path = Path.begin(start, rules, vertex.hit & (dr.max(scattered.weight) > 0))
    tally.add(Event.SECONDARY, owner, path.active)
    while dr.hint(path.active, exclude=[lookup, rules, start, tally, owner, no], label="Walk"):
        spare = SpareNumbers(sampler.next_1d())

        # ---------------------- Among what is held ----------------------

        ray = mi.Ray3f(path.ray)
        ray.maxt = dr.minimum(ray.maxt, tally.exit(owner, ray))
        si = scene.ray_intersect(ray, path.active)

        # ---------------------- Beyond ----------------------

        left = path.active & ~si.is_valid()
        mapped = left & path.bounded & (path.cluster == owner)
        _, trusted = lookup.far_field.eval(
            path.cluster,
            ray,
            path.pdf,
            path.specular,
            spare.next_1d(),
            spare.next_2d(),
            mapped,
        )
        unmapped = left & ~mapped & (owner < tally.n_clusters)
        tally.add(Event.MAP, owner, mapped & trusted)
        tally.add(Event.UNCERTAIN, owner, mapped & ~trusted)
        tally.add(Event.NARROW, owner, unmapped & (path.bounces == 0))
        tally.add(Event.OTHERS, owner, unmapped & (path.bounces > 0))

        # ---------------------- Go on or end ----------------------

        met = Vertex.met(lookup, si, path.ray, path.active)
        service = serve(lookup, rules, start, path, met, no, spare)
        light, further = light_and_direction(scene, lookup, rules, sampler, path, met, service)
        cached, further, ends = end_in_cache(lookup, rules, sampler, path, met, service, further)
        found += path.throughput * (light + cached)
        tally.read(owner, service.row >> 1, met.hit & service.served)
        scatter(lookup, path, met, service, further, spare)
        path.active &= met.hit & ~ends & (dr.max(path.throughput) != 0)
        roulette(sampler, path)
        ended = (met.hit & ~path.active) | (left & (owner == tally.n_clusters))
        tally.add(Event.INSIDE, owner, ended)
    return found


@dataclass(frozen=True)
class Samples:
    """Camera samples of a picture, all [N].

    o, d    [N, 3]  the last ray of each, from the sensor or from a mirror on the way
    pixel   which it belongs to, row by row
    owner   of what it hits, -1 if there is nothing
    shape   of the picture: height and width
    """

    o: np.ndarray
    d: np.ndarray
    pixel: np.ndarray
    owner: np.ndarray
    shape: tuple[int, int]

    def all_of(self, owner: int) -> np.ndarray:
        """Pixels of which all samples belong to an owner, [H, W]."""
        n_pixels = self.shape[0] * self.shape[1]
        others = np.bincount(self.pixel, self.owner != owner, n_pixels)
        return (others == 0).reshape(self.shape)


def camera_samples(
    scene: mi.Scene, lookup: Lookup, spp: int, seed: int, n_clusters: int
) -> Samples:
    """Samples of a picture by the first sensor, and whose they are."""
    width, height = scene.sensors()[0].film().size()
    n = width * height * spp
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed, n)
    pixel = dr.arange(mi.UInt32, n) % (width * height)
    hits = camera_hits(scene, lookup, sampler, pixel, n_clusters)
    owner = mi.Int32(hits.owner)
    owner = dr.select(hits.vertex.hit, owner, -1)
    dr.eval(hits.ray, owner)
    o, d = (np.array(v).T for v in (hits.ray.o, hits.ray.d))
    return Samples(o, d, pixel.numpy(), owner.numpy(), (height, width))
