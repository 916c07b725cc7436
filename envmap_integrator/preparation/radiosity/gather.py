"""Gather rays of the radiosity pass: what the patches receive, and from which of them.

One batch of rays per patch measures the light transport between patches once, as in ray tracing
based radiosity (Wallace et al. 1987).
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from ...lookup.irradiance_cache import packet_row
from ...lookup.lookup import Lookup
from ...lookup.patches import PARTS
from ...system.jit import R1, R2, mean_channel, mix, unit, upload
from ...system.progress import stage
from ...system.random_numbers import RandomNumbers
from ...system.spectrum import packet_wavelengths
from ...transport.direct_light import mis_weight
from ...transport.path import follow
from ...transport.rules import PathRules
from ...transport.state import PathStart
from .direct_light import finite, sample_irradiance
from .incidence import Incidence
from .unknowns import Unknowns

#: Gather rays per kernel launch: bounds memory.
MAX_LANES = 1 << 22
#: Bounces after which light that has grown shows that it does.
GROWTH_BOUNCES = 8
#: Floats that gather rays leave, and the iteration for them.
FLOATS_PER_RAY = 16


@dataclass(frozen=True)
class GatherRays:
    """What blocks of gather rays have found, ``samples`` N in each of B blocks.

    rank             [B]      place in ``Unknowns.patches`` of the unknown a block belongs to
    direct, escaped  [B]      W/m²: irradiance from emitters, and π b, the indirect light that comes
                              from no patch; means over the rays
    of_emitters, of_others [N * B]  W/m²: the same of each ray, mean of the colour channels
    weight           [N * B]  throughput with which a ray ends in a patch,
    row              [N * B]  ... and the row of the irradiance table that it ends in
    start, place     [N * B]  places where it starts and where it ends (``PathEnd.place``)
    """

    rank: np.ndarray
    direct: mi.Spectrum
    escaped: mi.Spectrum
    of_emitters: mi.Float
    of_others: mi.Float
    weight: mi.Spectrum
    row: mi.UInt32
    start: mi.UInt32
    place: mi.UInt32

    def __len__(self) -> int:
        """Number of blocks B."""
        return len(self.rank)

    @property
    def samples(self) -> int:
        """Rays N in a block."""
        return dr.width(self.row) // max(len(self), 1)

    def of_patches(self, packets: int) -> GatherRays:
        """The same by patches, whatever their packet."""
        if packets == 1:
            return self
        row = 2 * ((self.row >> 1) // packets) + (self.row & 1)
        start, place = (
            PARTS * (x // PARTS // packets) + x % PARTS for x in (self.start, self.place)
        )
        dr.eval(row, start, place)
        return replace(self, rank=self.rank // packets, row=row, start=start, place=place)

    @staticmethod
    def concatenate(parts: list[GatherRays]) -> GatherRays:
        """All blocks of several batches."""
        if len(parts) == 1:
            return parts[0]
        names = (field.name for field in fields(GatherRays))
        return GatherRays(*(_concatenate([getattr(part, n) for part in parts]) for n in names))


class Blocks:
    """Which blocks of gather rays stand for each of U unknowns, or of K patches.

    rank    [B]  place of a block's unknown, in ascending order
    count   [U]  number of blocks
    one_each     whether each unknown has one
    """

    def __init__(self, rank: np.ndarray, n_unknowns: int):
        self.rank = rank
        self.count = np.bincount(rank, minlength=n_unknowns)
        self.one_each = len(rank) == n_unknowns
        self._first = upload(mi.UInt32, np.cumsum(self.count) - self.count)
        self._count = upload(mi.UInt32, self.count)

    def mean(self, values: mi.Spectrum) -> mi.Spectrum:
        """Means [U] over the blocks of each unknown, always summed in the same order."""
        return values if self.one_each else self._mean(dr.ravel(values))

    @dr.syntax
    def _mean(self, values: mi.Float) -> mi.Spectrum:
        dr.eval(values)
        total, i = mi.Spectrum(0), mi.UInt32(0)
        while dr.hint(i < self._count, exclude=[self, values], label="Blocks of a patch"):
            total += dr.gather(mi.Spectrum, values, self._first + i)
            i += 1
        return total / mi.Float(self._count)


def gather(
    scene: mi.Scene,
    lookup: Lookup,
    unknowns: Unknowns,
    incidence: Incidence,
    rank: np.ndarray,
    samples: int,
    seed: int,
) -> GatherRays:
    """Send a block of rays, ``samples`` of them, from surface points for each unknown in ``rank``.

    Rays start from random ones of the points, with as many shadow rays. ``samples`` must be a power
    of two, and ``rank`` ascend.
    """
    launch = max(MAX_LANES // samples, 1)
    # Random numbers go by where a patch is and which of its blocks it is.
    member, packet = np.divmod(rank, unknowns.packets)
    number = (np.arange(len(rank)) - np.searchsorted(rank, rank)) * unknowns.packets + packet
    key = unknowns.members.keys[member] ^ (number * 0x9E3779B1).astype(np.uint32)
    found = []
    with stage("Gathering irradiance", total=len(rank)) as advance:
        for begin in range(0, len(rank), launch):
            some, keys = rank[begin : begin + launch], key[begin : begin + launch]
            found.append(_gather(scene, lookup, unknowns, incidence, some, keys, samples, seed + 1))
            advance(len(some))
    return GatherRays.concatenate(found)


def block_mean(value: mi.Spectrum | mi.Float, samples: int) -> mi.Spectrum | mi.Float:
    """Means over the rays of each block."""
    if dr.depth_v(value) == 1:
        return dr.block_sum(value, samples) / samples
    return type(value)(*(dr.block_sum(c, samples) / samples for c in value))


def _gather(scene, lookup, unknowns, incidence, rank, keys, samples, seed) -> GatherRays:
    members, packets = unknowns.members, unknowns.packets
    n_lanes = len(rank) * samples
    lane = dr.arange(mi.UInt32, n_lanes)
    block = lane >> dr.opaque(mi.UInt32, int(np.log2(samples)))
    member, packet = dr.gather(mi.UInt32, upload(mi.UInt32, rank), block), mi.UInt32(0)
    if packets > 1:
        member, packet = member // packets, member % packets
    key = dr.gather(mi.UInt32, upload(mi.UInt32, keys), block)
    k = lane & (dr.opaque(mi.UInt32, samples) - 1)
    numbers = RandomNumbers.of_keys(seed, key, k)
    point = members.sample(member, numbers.next_1d())
    si = members.points.interaction(point)
    patch = dr.gather(mi.UInt32, upload(mi.UInt32, members.patches), member)
    start_place = PARTS * patch + dr.gather(mi.UInt32, members.parts, point)

    # ---- Low-discrepancy numbers, rotated at random for each block (Cranley-Patterson) ----
    u = _rotated(mi.Float(k) / dr.opaque(mi.Float, samples), mi.radical_inverse_2(k, 0), key, seed)
    v = _rotated(mi.Float(k) * R2[0], mi.Float(k) * R2[1], key, ~seed & 0xFFFFFFFF)
    within_bin = _rotated(mi.Float(k) * R1, 0, key, seed ^ 0x55555555).x
    si.wavelengths = packet_wavelengths(packet, within_bin)

    # ---- Direction: cosine ----
    wo = mi.warp.square_to_cosine_hemisphere(u)
    pdf = mi.warp.square_to_cosine_hemisphere_pdf(wo)
    direction = si.to_world(wo)

    # ---- Direct light, by shadow rays and by the gather rays that hit an emitter ----
    emitter_row = lookup.emitters.row(
        dr.gather(mi.UInt32, upload(mi.UInt32, members.cells), member), True
    )
    ds, light = sample_irradiance(scene, lookup.emitters, si, emitter_row, v)
    cosine = dr.maximum(dr.dot(si.sh_frame.n, ds.d), 0)
    direct = light * dr.select(ds.delta, 1, mis_weight(ds.pdf, cosine * dr.inv_pi))
    direct *= incidence(point, cosine)

    start = PathStart(
        ray=si.spawn_ray(direction),
        depth=mi.UInt32(1),
        origin=mi.Interaction3f(si),
        emitter_row=emitter_row,
        pdf=pdf,
        specular=mi.Bool(False),
    )
    above = (dr.dot(si.n, direction) > 0) & (wo.z > 0)
    end_ = follow(scene, lookup, PathRules(), numbers, start, above)
    counts = incidence(point, wo.z)
    direct += dr.pi * counts * end_.direct
    escaped = dr.pi * counts * (end_.radiance - end_.direct)

    def each(function, x):
        return type(x)(*(function(component) for component in x))

    # Turned normals look below the surface too. Materials drop what comes from there, so that it is
    # dropped again where E is used: E is the mean of the rest.
    dropped = dr.select(above | ~members.points.is_turned(point), mi.Float(0), 1)
    kept = 1 - block_mean(dropped, samples)
    scale = dr.repeat(dr.select(kept > 0, dr.rcp(kept), 0), samples)
    direct, escaped, weight = (
        each(finite, scale * x) for x in (direct, escaped, counts * end_.weight)
    )
    of_emitters, of_others = mean_channel(direct), mean_channel(escaped)
    # Block sums evaluate what they sum up: without this, each of them would trace all rays anew.
    row = packet_row(end_.row, packet)
    start_place, place = (_packet_place(x, packet, packets) for x in (start_place, end_.place))
    dr.eval(direct, escaped, of_emitters, of_others, weight, row, place, start_place)
    direct, escaped = block_mean(direct, samples), block_mean(escaped, samples)
    dr.eval(direct, escaped, weight)
    return GatherRays(
        rank, direct, escaped, of_emitters, of_others, weight, row, start_place, place
    )


def _packet_place(place: mi.UInt32, packet: mi.UInt32, packets: int) -> mi.UInt32:
    """``PathEnd.place`` on the patch that stands for one of several packets."""
    if packets == 1:
        return place
    return PARTS * (packets * (place // PARTS) + packet) + place % PARTS


def without_growth(
    rays: GatherRays, blocks: Blocks, patch: np.ndarray, n_patches: int
) -> GatherRays:
    """The rays, with smaller throughputs where light would grow from bounce to bounce.

    No patch receives more than what the others reflect, unless by noise: few rays met heavy weights
    of a material. In a room that averages out; in a narrow vase, which sees itself, the solution
    would grow without end. There, blocks that bring more than all light get as much as all blocks
    do on average. ``patch`` [U] are those of the unknowns, of ``n_patches``.
    """
    whole = dr.max(block_mean(rays.weight, rays.samples))
    dr.eval(whole)
    if not dr.any(whole > 1):
        return rays
    light = dr.ones(mi.Float, len(mi.Spectrum()) * n_patches)
    place = upload(mi.UInt32, patch)
    for _ in range(GROWTH_BOUNCES):
        arriving = rays.weight * dr.gather(mi.Spectrum, light, rays.row >> 1)
        dr.eval(arriving)
        found = blocks.mean(block_mean(arriving, rays.samples))
        light = dr.zeros(mi.Float, dr.width(light))
        dr.scatter(light, found, place)
        dr.eval(light)
    grows = dr.gather(mi.Bool, dr.max(found) > 1, upload(mi.UInt32, blocks.rank))
    usual = dr.sum(dr.minimum(whole, 1)) / dr.opaque(mi.Float, dr.width(whole))
    factor = dr.select(grows & (whole > 1), usual / whole, 1)
    weight = rays.weight * dr.repeat(factor, rays.samples)
    dr.eval(weight)
    return replace(rays, weight=weight)


def _rotated(x, y, key, seed) -> mi.Point2f:
    """A point set moved round the unit square, by another shift for every block's key."""
    seed_ = dr.opaque(mi.UInt32, seed)
    bits = (mix(mix(2 * key + axis) ^ seed_) for axis in range(2))
    shift = mi.Point2f(*map(unit, bits))
    point = mi.Point2f(x, y) + shift
    return point - dr.floor(point)


def _concatenate(parts):
    """One array of numbers or spectra in place of several."""
    if isinstance(parts[0], np.ndarray):
        return np.concatenate(parts)
    if dr.depth_v(parts[0]) == 1:
        return dr.concat(parts)
    return type(parts[0])(*(dr.concat(components) for components in zip(*parts, strict=True)))
