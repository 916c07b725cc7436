"""From camera samples to the film: all samples of a pixel, and the filter of what they gather."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from operator import add

import drjit as dr
import mitsuba as mi

from ..lookup.lookup import Lookup
from ..system.fingerprint import SensorConstants
from ..system.interrupt import memory, not_interrupted
from ..system.jit import LANES_ALIKE, give_back
from ..system.progress import stage
from ..system.recording import Recorder
from ..system.spectrum import colour, rgb, wavelength_sample
from ..transport.camera import CameraSample
from ..transport.gathered import Gathered
from ..transport.rules import PathRules
from .aovs import Aov, camera_sample
from .irradiance_filter import filter_irradiance, pixel_records, tolerance
from .pixel_filter import PixelFilter
from .sample_points import SamplePoints, shared_strata

#: What surfaces gather, as AOVs: as in the picture, before pixels share it, and what it's in
#: proportion to.
INDIRECT_AOVS = tuple(f"{name}.{c}" for name in ("indirect", "gathered", "albedo") for c in "RGB")
#: Lanes of a render at least, where it has as many samples (fewer would leave threads idle), and at
#: most, which is Dr.Jit's limit.
MIN_LANES, MAX_LANES = 1 << 20, (1 << 32) - 1


@dataclass(frozen=True)
class Shading:
    """What finds the light of a sample: all that paths read, how they go, and AOVs to find."""

    scene: mi.Scene
    lookup: Lookup
    rules: PathRules
    aovs: tuple[Aov, ...] = ()

    def __call__(
        self,
        sampler: mi.Sampler | SamplePoints,
        ray: mi.Ray3f,
        index: mi.UInt32,
        pixel: mi.UInt32,
    ) -> CameraSample:
        """The light that comes along the ray of the sample of an index in its pixel."""
        rules, active = self.rules.of_sample(index, pixel), mi.Bool(True)
        return camera_sample(self.scene, self.lookup, rules, self.aovs, sampler, ray, active)


@dataclass(frozen=True)
class Share:
    """Which samples of which pixel a lane takes, all [1].

    pixel          the first pixel
    seed           of the sample points,
    strata         ... and the ``shared_strata`` of all samples of a render
    start          the first sample
    least, longer  samples of each of the lanes that share a pixel, and how many take one more
    """

    pixel: mi.UInt32
    seed: mi.UInt32
    strata: mi.UInt32
    start: mi.UInt32
    least: mi.UInt32
    longer: mi.UInt32

    @classmethod
    def of(cls, pixel: int, seed: int | mi.UInt32, spp: int, start: int, parts: int) -> Share:
        """Those of ``spp`` samples from ``start`` on for ``parts`` lanes."""
        numbers = pixel, seed & 0xFFFFFFFF, shared_strata(spp), start, *divmod(spp, parts)
        share = cls(*map(mi.UInt32, numbers))
        dr.make_opaque(share)
        return share


def pixel_ranges(n_pixels: int, sizes: Iterable[int]) -> list[range]:
    """The pixels of a film in ranges of about these sizes, which may be rendered apart."""
    ranges, begin = [], 0
    for size in sizes:
        end = min(begin + -(-size // LANES_ALIKE) * LANES_ALIKE, n_pixels)
        if end > begin:
            ranges.append(range(begin, end))
        begin = end
    return ranges


def most_samples(sensor: mi.Sensor) -> int:
    """Samples per pixel at most with Mitsuba's samplers, which need a lane for each."""
    return MAX_LANES // n_pixels_of(sensor.film())


#: Sums over the samples of each pixel, row by row: one array for each channel.
Sums = list["mi.Float"]


def plain_sums(
    sensor: mi.Sensor,
    sampler: mi.Sampler | None,
    spp: int,
    seed: int,
    shading: Shading,
    recorder: Recorder,
    n_aovs: int,
    aovs: Callable[[CameraSample], list[mi.Float]],
    first: int = 0,
    pixels: range | None = None,
) -> Sums:
    """Render ``spp`` samples per pixel of a sensor.

    ``sampler`` is one of Mitsuba's, or None for our own sample points, from the ``first`` on.
    ``aovs`` gives the ``n_aovs`` values of a ``CameraSample`` that are to go to channels of their
    own. Without them, ``recorder`` launches again what it has recorded. With our own sample points,
    only some ``pixels`` may be asked for, as ``pixel_ranges`` gives them: their sums are those that
    all have, to the bit.
    """

    def channels(film, found, weight, wavelengths):
        values = (weight * value for value in aovs(found))
        return [*_plain(film, found, weight, wavelengths), *values]

    record, made = (_directly, channels) if n_aovs else (recorder, _plain)
    return _accumulate(sensor, sampler, spp, seed, shading, record, made, n_aovs, first, pixels)


def put_plain(sensor: mi.Sensor, sums: Sums, names: list[str]) -> None:
    """Put ``plain_sums`` to the film of the sensor, with AOVs of the given ``names``."""
    sensor.film().prepare(names)
    _put(sensor, sums)


def gathered_sums(
    sensor: mi.Sensor,
    sampler: mi.Sampler | None,
    spp: int,
    seed: int,
    shading: Shading,
    recorder: Recorder,
    first: int = 0,
    pixels: range | None = None,
) -> Sums:
    """As ``plain_sums``, with the AOVs of ``shading``, and what surfaces gather taken apart."""
    n_aovs = sum(len(aov.channels()) for aov in shading.aovs)
    record, n_further = _directly if n_aovs else recorder, n_aovs + Gathered.count()
    return _accumulate(
        sensor, sampler, spp, seed, shading, record, _apart, n_further, first, pixels
    )


def put_gathered(
    sensor: mi.Sensor, sums: Sums, n_shared: int, names: list[str], with_aovs: bool
) -> None:
    """Put ``gathered_sums`` to the film of the sensor, with AOVs of the given ``names``.

    ``INDIRECT_AOVS`` come after them, if asked for.

    Pixels share what they gather with ``n_shared`` rays each, unless that is 0. The list is used
    up: these are the largest arrays of a render, and none outlives its use.
    """
    n_guides = Gathered.count()
    gathered = Gathered.of_channels(sums[-n_guides:])
    del sums[-n_guides:]
    indirect = gathered.radiance
    aovs = [*rgb(gathered.radiance), *rgb(gathered.albedo)] if with_aovs else []
    if n_shared:
        records = pixel_records(gathered)
        del gathered, indirect
        give_back(dr.width(records))
        width = int(sensor.film().crop_size()[0])
        indirect = filter_irradiance(records, width, tolerance(n_shared))
    for index, value in enumerate(rgb(indirect)):
        sums[index] = sums[index] + value
    if with_aovs:
        sums += [*rgb(indirect), *aovs]
    sensor.film().prepare([*names, *(INDIRECT_AOVS if with_aovs else [])])
    _put(sensor, sums)


def _put(sensor: mi.Sensor, sums: Sums) -> None:
    """Put sums over the samples of each pixel to a film that is prepared for them."""
    film = sensor.film()
    if has_bands(film):  # Its weight comes last.
        sums.append(sums.pop(_n_shown(film) - 1))
    width, height = (int(n) for n in film.crop_size())
    picture = dr.empty(mi.Float, len(sums) * height * width)
    first = len(sums) * dr.arange(mi.UInt32, height * width)
    for index, value in enumerate(sums):
        dr.scatter(picture, value, first + index)
    tensor = mi.TensorXf(picture, (height, width, len(sums)))
    film.put_block(mi.ImageBlock(tensor, film.crop_offset()))


def _plain(film, found, weight, wavelengths):
    return _shown(film, found.radiance, found.valid, weight, wavelengths)


def _apart(film, found, weight, wavelengths):
    apart = found.radiance - found.gathered.radiance
    aovs = (weight * value for value in found.aovs)
    shown = _shown(film, apart, found.valid, weight, wavelengths)
    return [*shown, *aovs, *found.gathered.to_add(wavelengths).channels()]


def _directly(key, function, *inputs):
    return function(*inputs)


def _accumulate(
    sensor, sampler, spp, seed, shading, recorder, channels, n_further, first, pixels
) -> Sums:
    """Sums over the samples of each pixel, row by row, of ``channels(film, found, weight)``."""
    film = sensor.film()
    if has_bands(film):
        film.prepare([])  # It has no channels before.
    n_pixels, width = n_pixels_of(film), dr.opaque(mi.UInt32, int(film.crop_size()[0]))
    n_channels = _n_shown(film) + n_further
    values = _Values(sensor, PixelFilter.of(film.rfilter()), width, shading, channels)
    with stage("Rendering"):
        if sampler is None:
            parts = min(-(-MIN_LANES // n_pixels), spp)
            pixels = pixels or range(n_pixels)
            share = Share.of(pixels.start, seed, spp, first, parts)
            constants = SensorConstants(sensor)
            # What films with bands show of themselves, dr.freeze mixes up.
            record = _directly if constants.in_python or has_bands(film) else recorder
            arguments = values, share, memory(), len(pixels), parts, n_channels
            # What film and sampler hold would be recorded too: as mi.render leaves them.
            film.prepare([])
            sensor.sampler().seed(0, 1)
            sums = record(constants, _lane_per_pixel, *arguments)
        else:
            sums = _lane_per_sample(values, n_pixels, spp, seed, n_channels, sampler)
        dr.eval(sums)
        dr.sync_thread()
    return list(sums)


@dataclass(frozen=True)
class _Values:
    """What a sample adds to the channels of its pixel."""

    sensor: mi.Sensor
    pixel_filter: PixelFilter
    width: mi.UInt32
    shading: Shading
    channels: Callable[[mi.Film, CameraSample, mi.Float], list[mi.Float]]

    def __call__(self, sampler, pixel, index) -> list[mi.Float]:
        film = self.sensor.film()
        position = mi.Vector2i(pixel % self.width, pixel // self.width)
        position += mi.Vector2i(film.crop_offset())

        def shade(sampler, ray):
            return self.shading(sampler, ray, index, pixel)

        sample = _sample(self.sensor, self.pixel_filter, sampler, shade, position)
        return self.channels(film, *sample)


def _lane_per_pixel(values, share, memory, n_pixels, parts, n_channels):
    """A lane takes the samples of one pixel in turn, or a part of them where pixels are few.

    Nothing is stored for a sample, and neighbouring lanes are neighbouring pixels: the same ones,
    whichever range of pixels is rendered, since what rays hit that are traced together might hang
    on each other in the last bit.
    """
    row = n_pixels if parts == 1 else -(-n_pixels // LANES_ALIKE) * LANES_ALIKE
    lane, row_ = dr.arange(mi.UInt32, row * parts), dr.opaque(mi.UInt32, row)
    place, part = lane % row_, lane // row_
    first = share.start + part * share.least + dr.minimum(part, share.longer)
    end = first + share.least + dr.select(part < share.longer, mi.UInt32(1), 0)
    end = dr.select(place < dr.opaque(mi.UInt32, n_pixels), end, first)
    sums = [dr.zeros(mi.Float, row * parts) for _ in range(n_channels)]
    pixel = share.pixel + place
    points = SamplePoints.of(share.seed, pixel, share.strata, first)
    sums = _sums(values, points, pixel, end, memory, sums)
    if parts == 1:
        return sums
    dr.eval(sums)
    lane, parts_ = dr.arange(mi.UInt32, n_pixels * parts), dr.opaque(mi.UInt32, parts)
    lanes_of_pixel = lane % parts_ * row_ + lane // parts_
    return [dr.block_sum(dr.gather(mi.Float, s, lanes_of_pixel), parts) for s in sums]


@dr.syntax
def _sums(values, points, pixel, end, memory, sums):
    index = mi.UInt32(points.index)
    going = index < end
    # What never changes is no state of the loop: Dr.Jit would find out, and record all anew.
    while dr.hint(going, exclude=[values, points, pixel, end, memory], label="Samples of a pixel"):
        sums = [*map(add, sums, values(points.of_sample(index), pixel, index))]
        index += 1
        going &= (index < end) & not_interrupted(memory, index)
    return sums


def _lane_per_sample(values, n_pixels, spp, seed, n_channels, sampler):
    """Mitsuba's samplers want the samples of a pixel side by side."""
    sampler.set_samples_per_wavefront(spp)
    sampler.seed(seed, n_pixels * spp)
    index, spp_ = dr.arange(mi.UInt32, n_pixels * spp), dr.opaque(mi.UInt32, spp)
    sums = [dr.zeros(mi.Float, n_pixels) for _ in range(n_channels)]

    def trace(sampler, index):
        pixel = index // spp_
        for total, value in zip(sums, values(sampler, pixel, index % spp_), strict=True):
            dr.scatter_add(total, value, pixel)
        return sampler, index

    def leave(sampler, index):
        return sampler, index

    going = not_interrupted(memory(), index)
    dr.if_stmt((sampler, index), going, trace, leave, mode="symbolic")
    return sums


def _sample(sensor, pixel_filter, sampler, shade, position):
    """The ``CameraSample`` of one sample of each pixel, weighted, its weight in the pixel, and its
    wavelengths.
    """
    film = sensor.film()
    offset, filter_weight = pixel_filter.sample(sampler.next_2d())
    place = mi.Vector2f(position) + 0.5 + offset
    within = (place - mi.Vector2f(film.crop_offset())) / mi.Vector2f(film.crop_size())
    aperture = sampler.next_2d() if sensor.needs_aperture_sample() else mi.Point2f(0.5)
    time = mi.Float(sensor.shutter_open())
    if sensor.shutter_open_time() > 0:
        time += sampler.next_1d() * sensor.shutter_open_time()
    which = wavelength_sample(sampler)
    ray, weight = sensor.sample_ray_differential(time, which, within, aperture)
    found = shade(sampler, mi.Ray3f(ray))
    return found.scaled(weight * filter_weight), filter_weight, ray.wavelengths


def n_pixels_of(film: mi.Film) -> int:
    """Pixels that a film keeps."""
    return int(film.crop_size()[0]) * int(film.crop_size()[1])


def _shown(film: mi.Film, radiance, valid, weight, wavelengths) -> list[mi.Float]:
    """What every film holds: colour, alpha if wanted, and the weight of a sample."""
    if has_bands(film):
        return film.prepare_sample(radiance, wavelengths, _n_shown(film), weight)
    alpha = [dr.select(valid, weight, 0)] if _has_alpha(film) else []
    return [*rgb(colour(radiance, wavelengths)), *alpha, weight]


def _n_shown(film: mi.Film) -> int:
    """Number of ``_shown``."""
    return film.base_channels_count() + 1 if has_bands(film) else 4 + _has_alpha(film)


def _has_alpha(film: mi.Film) -> bool:
    return mi.has_flag(film.flags(), mi.FilmFlags.Alpha)


def has_bands(film: mi.Film) -> bool:
    """Does it hold spectral bands in place of a colour?"""
    return mi.has_flag(film.flags(), mi.FilmFlags.Special)
