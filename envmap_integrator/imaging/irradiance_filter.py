"""Neighbouring pixels share the indirect light that they have gathered.

Irradiance changes slowly where what it comes from is far away: by no more than the distance
between two points over the harmonic mean distance of what they see, and with the turn of the
normal (the split-sphere model of Ward, Rubinstein and Clear 1988). As irradiance caching does in
space, this filter averages it in the image over places between which it can't change by more than
a tolerance (Kontkanen, Räsänen and Keller 2004). Direct light, sources, gloss and textures aren't
touched.

Where a surface ends, all neighbours are on one side, and the mean is that of a place farther in,
often brighter by much: beside a dark wall or a reveal, irradiance falls faster than by the model,
as what is left of it is small. So a plane is fitted to what they have (local linear regression,
Fan 1992), and the pixel gets the value at its own place, as far as that is certain.

Rare bright samples would become discs as wide as the filter. As Zirr, Hanika and Dachsbacher (2018)
do, it asks how many others have found as much: where hardly any has, a pixel shares only what is
usual around it. The excess goes to an area so much larger that it doesn't show, and what would show
even there stays in the pixel. So no light is lost.
"""

from __future__ import annotations

from dataclasses import dataclass
from operator import add

import drjit as dr
import mitsuba as mi

from ..system.spectrum import colour_type
from ..transport.gathered import Gathered

#: Pixels on each side that may contribute. What is farther away adds cost but hardly less noise.
RADIUS = 4
#: Relative change of irradiance that one sample per pixel allows for; with n samples it is n^(-1/6)
#: times that. The bias that it leaves grows with its square, the variance falls with its square:
#: so the sum of squared bias and variance is least for every n.
TOLERANCE = 0.5
#: A pixel is an outlier if fewer than SUPPORT of its neighbours, were all of them alike, have found
#: at least an EXCESS-th of its irradiance. It takes four contributors to halve the noise of one.
#: Few other pixels qualify: of N = 68 neighbours with an exponential distribution, more uneven than
#: most, the fourth largest is below a third of yet another value with the probability
#: 4·5·6 / ((N + 1) (N + 2) (N + 3)), 1 in 3000.
SUPPORT, EXCESS = 4, 3
#: Distance in pixels of those that first get the excess; then it's shared around each.
STRIDE = 4
#: Most of the excess that is spread, over what an outlier shares as others do. The excess covers
#: STRIDE² times the area and STRIDE times the width: with STRIDE³ it fades as gently as the share.
MOST_SPREAD = STRIDE**3
#: Variance of a place within its pixel [pixels²], along either side.
WITHIN_PIXEL = 1 / 12
#: Floats of a pixel's record: a cache line. Which of them say how much a pixel shares and spreads.
_RECORD, _SHARE, _SPREAD = 16, 11, 15
_DIAMETER = 2 * RADIUS + 1
_N_PLACES = _DIAMETER**2
_N_NEIGHBOURS = 68  # with a taper above 0


def tolerance(n_samples: int) -> float:
    """Relative change of irradiance that is allowed for with so many samples per pixel."""
    return TOLERANCE * n_samples ** (-1 / 6)


def filter_irradiance(records: mi.Float, width: int, allowed: float) -> mi.Spectrum | mi.Color3f:
    """The gathered radiance of every pixel, from the irradiance around it.

    ``records`` are those of an image of ``width`` pixels, row by row; ``allowed`` is the
    ``tolerance``. The unit is that of the sums in the records.
    """
    sharpness = dr.opaque(mi.Float, 1 / allowed)
    pixel = _pixels(records)
    share, spread = _parts(records, width, sharpness)
    dr.eval(share, spread)
    dr.scatter(records, share, _RECORD * pixel + _SHARE)
    dr.scatter(records, spread, _RECORD * pixel + _SPREAD)
    own = _Record.of(records, pixel, True)
    reached = _reached(spread > 0, width)
    far = _share(records, width, sharpness, STRIDE, _Record.spread, _mean, reached)
    shared, kept = own.shared() + far, own.whole() - own.shared() - own.spread()
    dr.eval(shared, kept)
    dr.scatter(records, mi.Vector4f(*shared, 0), (_RECORD // 4) * pixel + 2)
    result = _share(records, width, sharpness, 1, _Record.whole, _level, mi.Bool(True)) + kept
    kind = colour_type()
    result = kind(*(result[c] for c in range(len(kind()))))
    dr.eval(result)
    return result


def pixel_records(gathered: Gathered) -> mi.Float:
    """What neighbours ask a pixel for, from sums over its samples [_RECORD * pixels]."""
    n_pixels = dr.width(gathered.weight)
    # What isn't finite would spread.
    finite = dr.isfinite(dr.sum(gathered.radiance) + dr.sum(gathered.albedo))
    shared = (gathered.weight > 0) & finite
    scale = dr.select(shared, dr.rcp(gathered.weight), 0)
    near = mi.Vector4f(gathered.nearness * scale)
    length = dr.sqrt(dr.squared_norm(gathered.normal))
    near.x, near.y, near.z = dr.select(shared & (length > 0), gathered.normal / length, 0)
    place = mi.Vector4f(dr.select(shared, mi.Float(1), 0))
    place.x, place.y, place.z = gathered.position * scale
    records = dr.empty(mi.Float, _RECORD * n_pixels)
    first = (_RECORD // 4) * dr.arange(mi.UInt32, n_pixels)
    reflected, albedo = dr.sum(gathered.radiance), dr.sum(gathered.albedo)
    irradiance = dr.select(shared & (albedo > 0), reflected / albedo, 0)
    colours = (_padded(gathered.radiance, 1), _padded(gathered.albedo, irradiance))
    for index, value in enumerate((near, place, *colours)):
        dr.scatter(records, value, first + index)
    dr.eval(records)
    return records


def _padded(colour: mi.Spectrum, last: mi.Float) -> mi.Vector4f:
    return mi.Vector4f(*colour, *[0] * (3 - len(colour)), last)


@dataclass
class _Record:
    """What neighbours ask a pixel for.

    near       normal; in w, nearness
    place      position; in w, whether there is a surface
    radiance   in w, the part of it that is shared
    albedo     in w, irradiance as a mean over colours, later the part of radiance that is spread
    """

    near: mi.Vector4f
    place: mi.Vector4f
    radiance: mi.Vector4f
    albedo: mi.Vector4f

    @classmethod
    def of(cls, records: mi.Float, pixel: mi.UInt32, active: mi.Bool) -> _Record:
        first = (_RECORD // 4) * pixel
        return cls(*(dr.gather(mi.Vector4f, records, first + i, active) for i in range(4)))

    def shared(self) -> mi.Vector3f:
        """Radiance that the pixels around get a part of."""
        return self.radiance.w * self.radiance.xyz

    def spread(self) -> mi.Vector3f:
        """Radiance that pixels ``STRIDE`` apart get a part of."""
        return self.albedo.w * self.radiance.xyz

    def whole(self) -> mi.Vector3f:
        """All radiance."""
        return self.radiance.xyz

    def similarity(self, other: _Record, sharpness: mi.Float) -> mi.Float:
        """1 where the other has the same irradiance, 0 where it has any or none."""
        distance = dr.norm(other.place.xyz - self.place.xyz)
        turn = dr.sqrt(dr.maximum(1 - dr.dot(other.near.xyz, self.near.xyz), 0))
        change = (distance * dr.maximum(other.near.w, self.near.w) + turn) * sharpness
        return dr.select(other.place.w > 0, dr.exp(-dr.square(change)), 0)


def _parts(records, width, sharpness):
    """The parts of its radiance that each pixel shares nearby and that it spreads.

    They are 1 and 0, but of outliers.
    """
    own = _Record.of(records, _pixels(records), True)
    irradiance = own.albedo.w
    near = _support(records, width, sharpness, 1, own.place.w > 0)
    outlier = _N_NEIGHBOURS * near.as_bright < SUPPORT * near.alike
    usual = near.dimmer / (near.alike - near.as_bright)
    share = dr.select(outlier, EXCESS * usual / irradiance, 1)
    far = _support(records, width, sharpness, STRIDE, outlier)
    alike, as_bright = near.alike + far.alike, near.as_bright + far.as_bright
    usual = (near.dimmer + far.dimmer + as_bright * irradiance) / alike
    most = MOST_SPREAD * EXCESS * usual / irradiance
    return share, dr.select(outlier, dr.minimum(1 - share, most), 0)


@dataclass
class _Support:
    """What alike neighbours have found.

    alike       [1]     how many there are
    as_bright   [1]     how many of them have found at least an ``EXCESS``-th as much
    dimmer      [W/m²]  sum of the irradiance of the others
    """

    alike: mi.Float
    as_bright: mi.Float
    dimmer: mi.Float


@dr.syntax
def _support(records, width, sharpness, stride, active):
    """The ``_Support`` of pixels among those that are ``stride`` apart.

    The sums end where an outlier is ruled out, which for most pixels is after a few places.
    """
    pixel = _pixels(records)
    own = _Record.of(records, pixel, active)
    i = mi.UInt32(0)
    active = mi.Bool(active)
    alike, as_bright, dimmer = mi.Float(0), mi.Float(0), mi.Float(0)
    while dr.hint(active & (i < _N_PLACES), exclude=[records], label="Find outliers"):
        other, taper = _neighbour(records, width, pixel, i, stride)
        theirs = _Record.of(records, other, active & (taper > 0))
        similar = dr.select(taper > 0, own.similarity(theirs, sharpness), 0)
        supports = EXCESS * theirs.albedo.w >= own.albedo.w
        alike += similar
        as_bright += dr.select(supports, similar, 0)
        dimmer += dr.select(supports, 0, similar * theirs.albedo.w)
        active &= as_bright < SUPPORT
        i += 1
    return _Support(alike, as_bright, dimmer)


@dr.syntax
def _share(records, width, sharpness, stride, part, estimate, needed):
    """That ``part`` of radiance which goes with irradiance as pixels ``stride`` apart have it.

    ``estimate`` makes it of their ``_moments``. Where that isn't ``needed``, a pixel keeps its own.
    """
    pixel = _pixels(records)
    own = _Record.of(records, pixel, True)
    albedo = own.albedo.xyz
    i = mi.UInt32(0)
    active = needed & (own.place.w > 0)
    sums = _moments(part(own), albedo, mi.Float(1), mi.Float(0), mi.Float(0))
    while dr.hint(active & (i < _N_PLACES), exclude=[records], label="Share irradiance"):
        other, taper = _neighbour(records, width, pixel, i, stride)
        theirs = _Record.of(records, other, active & (taper > 0))
        weight = dr.select(taper > 0, taper * own.similarity(theirs, sharpness), 0)
        dx, dy = (mi.Float(d) for d in _offset(i))
        sums = [*map(add, sums, _moments(part(theirs), theirs.albedo.xyz, weight, dx, dy))]
        i += 1
    return dr.select(active & (albedo > 0), estimate(sums) * albedo, part(own))


def _moments(radiance, albedo, weight, dx, dy):
    """What a pixel adds to sums over those around one, each a colour.

    Each counts by its albedo, too. They are the weight, irradiance, the square of the weight, x, y
    and the products of these, irradiance times x and y, and its square.
    """
    w = dr.select(weight > 0, weight * albedo, 0)
    e = dr.select(w > 0, weight * radiance, 0)
    square = dr.select(w > 0, e * radiance / albedo, 0)
    products = (w * dx * dx, w * dx * dy, w * dy * dy)
    return [w, e, w * w, w * dx, w * dy, *products, e * dx, e * dy, square]


def _mean(sums):
    """The mean irradiance, from sums of ``_moments``."""
    return sums[1] / sums[0]


def _level(sums):
    """The irradiance in the middle, as a plane fitted to that around it has it, from ``_moments``.

    It differs from the mean by ``change``. The square of that is too large by the variance of its
    noise, on average, as the scatter around the plane tells it: so much is taken off, and nothing
    is left of a change that might be noise alone. Pixels have a width: on a line of them, the slope
    across is 0.
    """
    weight, e, squares, *others = sums
    e, x, y, xx, xy, yy, ex, ey, ee = (s / weight for s in (e, *others))
    n_alike = dr.square(weight) / squares
    xx, xy, yy = xx - x * x + WITHIN_PIXEL, xy - x * y, yy - y * y + WITHIN_PIXEL
    ex, ey, ee = ex - e * x, ey - e * y, ee - e * e
    determinant = xx * yy - xy * xy
    u, v = (yy * x - xy * y) / determinant, (xx * y - xy * x) / determinant
    change = -(u * ex + v * ey)
    explained = (yy * ex * ex - 2 * xy * ex * ey + xx * ey * ey) / determinant
    scatter = dr.maximum(ee - explained, 0) / (n_alike - 3)  # A plane takes three of them.
    noise = scatter * (u * x + v * y)
    certain = (n_alike > 3) & (dr.square(change) > noise)
    return dr.maximum(e + dr.select(certain, change - noise / change, 0), 0)


def _pixels(records: mi.Float) -> mi.UInt32:
    return dr.arange(mi.UInt32, dr.width(records) // _RECORD)


def _reached(outlier: mi.Bool, width: int) -> mi.Bool:
    """Pixels that may get some of an outlier's excess: those in its tile and the tiles around."""
    pixel = dr.arange(mi.UInt32, dr.width(outlier))
    size = STRIDE * RADIUS
    # With a row and a column more on each side.
    across, down = (n // size + 3 for n in (width, dr.width(outlier) // width))
    width_, across_ = dr.opaque(mi.UInt32, width), dr.opaque(mi.UInt32, across)
    first = pixel // width_ // size * across_ + pixel % width_ // size
    marked = dr.zeros(mi.UInt32, across * down)
    dr.scatter(marked, 1, first + across_ + 1, outlier)
    around = (first + row * across_ + column for row in range(3) for column in range(3))
    return sum(dr.gather(mi.UInt32, marked, tile) for tile in around) > 0


def _neighbour(records, width, pixel, i, stride):
    """The i-th pixel around one, the near ones first, and its weight: 0 if there is none.

    The weight falls off to all sides, so that no square shows around a bright pixel.
    """
    width_ = dr.opaque(mi.Int32, width)
    height = dr.opaque(mi.Int32, dr.width(records) // (_RECORD * width))
    dx, dy = _offset(i)
    taper = 1 - mi.Float(dx * dx + dy * dy) / (RADIUS + 1) ** 2
    x = mi.Int32(pixel) % width_ + stride * dx
    y = mi.Int32(pixel) // width_ + stride * dy
    inside = (x >= 0) & (x < width_) & (y >= 0) & (y < height) & ((dx != 0) | (dy != 0))
    return mi.UInt32(y * width_ + x), dr.select(inside, dr.maximum(taper, 0), 0)


def _offset(i):
    """Where the i-th pixel is, in units of the stride across and down."""
    place = (i + _N_PLACES // 2) % _N_PLACES
    return mi.Int32(place % _DIAMETER) - RADIUS, mi.Int32(place // _DIAMETER) - RADIUS
