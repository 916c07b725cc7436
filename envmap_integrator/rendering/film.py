"""From camera samples to the film: passes over all pixels, and the filter of what they gather."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..interrupt import going_on
from ..progress import stage
from .irradiance_filter import Gathered, filter_irradiance, tolerance

#: Camera rays per kernel launch, as Mitsuba has it. Within one launch nothing is stored for a ray;
#: between launches, the samplers' states are.
MAX_LANES = (1 << 32) - 1


def pixel_sampler(sensor: mi.Sensor, plugin: str, spp: int) -> mi.Sampler:
    """A sampler for ``spp`` samples per pixel, or as many as the scene asks for if that is 0.

    ``plugin`` names it; ``scene`` stands for the sensor's own. Samplers that stratify may round the
    number up to that of a full grid.
    """
    own = sensor.sampler()
    spp = spp or own.sample_count()
    sampler = own.clone() if plugin == "scene" else mi.load_dict({"type": plugin})
    sampler.set_sample_count(spp)
    return sampler


def expose(sensor: mi.Sensor, sampler: mi.Sampler, seed, shade, names: list[str], aovs) -> None:
    """Render to the film of a sensor.

    ``shade(sampler, ray)`` gives a ``CameraSample``, and ``aovs`` the values of it that are to go
    to channels of the given ``names``.
    """
    film = sensor.film()
    film.prepare(names)

    def channels(found):
        return found.radiance, aovs(found)

    film.put_block(_accumulate(sensor, sampler, seed, shade, channels))


def expose_filtered(sensor: mi.Sensor, sampler: mi.Sampler, seed, shade, n_samples: int) -> None:
    """Render to the film of a sensor; pixels share what they gather with ``n_samples`` rays each.

    ``shade(sampler, ray)`` gives a ``CameraSample``.
    """

    def channels(found):
        return found.radiance - found.gathered.radiance, found.gathered.channels()

    film = sensor.film()
    n_guides = Gathered.count()
    film.prepare([f"gathered{i}" for i in range(n_guides)])
    block = _accumulate(sensor, sampler, seed, shade, channels)
    tensor = block.tensor()
    height, width, n_channels = tensor.shape
    pixel = dr.arange(mi.UInt32, height * width)
    sums = [dr.gather(mi.Float, tensor.array, pixel * n_channels + i) for i in range(n_channels)]
    shown, guides = sums[:-n_guides], sums[-n_guides:]
    shared = filter_irradiance(Gathered.of_channels(guides), width, tolerance(n_samples))
    for index, value in enumerate(_rgb(shared)):
        shown[index] += value

    film.prepare([])
    picture = dr.empty(mi.Float, len(shown) * height * width)
    for index, value in enumerate(shown):
        dr.scatter(picture, value, pixel * len(shown) + index)
    picture = mi.TensorXf(picture, (height, width, len(shown)))
    film.put_block(mi.ImageBlock(picture, block.offset()))


def _accumulate(sensor, sampler, seed, shade, channels) -> mi.ImageBlock:
    """Sums over the samples of each pixel, in the channels that the film has been prepared for.

    ``channels(found)`` gives the radiance of a ``CameraSample`` that is shown, and the values of
    further channels.
    """
    film = sensor.film()
    size = mi.ScalarVector2u(film.crop_size())
    border = film.rfilter().border_size() if film.sample_border() else 0
    size += 2 * border
    spp = sampler.sample_count()
    n_pixels = int(size[0]) * int(size[1])
    n_passes = _passes(n_pixels, spp)
    spp_per_pass = spp // n_passes
    sampler.set_samples_per_wavefront(spp_per_pass)
    sampler.seed(seed, n_pixels * spp_per_pass)

    block = film.create_block()
    block.set_offset(film.crop_offset())
    block.set_coalesce(block.coalesce() and spp_per_pass >= 4)
    index = dr.arange(mi.UInt32, n_pixels * spp_per_pass) // dr.opaque(mi.UInt32, spp_per_pass)
    width = dr.opaque(mi.UInt32, int(size[0]))
    position = mi.Vector2i(index % width, index // width)
    position += mi.Vector2i(film.crop_offset()) - border
    with stage("Rendering", total=n_passes) as advance:
        for _ in range(n_passes):
            _pass(sensor, sampler, shade, channels, block, position)
            if n_passes > 1:
                sampler.advance()
                sampler.schedule_state()
                dr.eval(block.tensor())
                dr.sync_thread()
            advance(1)
    return block


def _passes(n_pixels: int, spp: int) -> int:
    """The least number of equal passes that are small enough, if there can be."""
    least = -(-n_pixels * spp // MAX_LANES)
    return next(n for n in range(min(least, spp), spp + 1) if spp % n == 0)


def _pass(sensor, sampler, shade, channels, block, position) -> None:
    """One sample or several of each pixel, unless Ctrl-C has been pressed."""

    def trace(sampler, position):
        _trace(sensor, sampler, shade, channels, block, position)
        return sampler, position

    def leave(sampler, position):
        return sampler, position

    lane = dr.arange(mi.UInt32, dr.width(position))
    dr.if_stmt((sampler, position), going_on(lane), trace, leave, mode="symbolic")


def _trace(sensor, sampler, shade, channels, block, position) -> None:
    film = sensor.film()
    place = mi.Vector2f(position) + sampler.next_2d()
    within = (place - mi.Vector2f(film.crop_offset())) / mi.Vector2f(film.crop_size())
    aperture = sampler.next_2d() if sensor.needs_aperture_sample() else mi.Point2f(0.5)
    time = mi.Float(sensor.shutter_open())
    if sensor.shutter_open_time() > 0:
        time += sampler.next_1d() * sensor.shutter_open_time()
    ray, weight = sensor.sample_ray_differential(time, 0, within, aperture)
    found = shade(sampler, mi.Ray3f(ray)).scaled(weight)
    radiance, further = channels(found)
    values = [*_rgb(radiance)]
    if mi.has_flag(film.flags(), mi.FilmFlags.Alpha):
        values.append(dr.select(found.valid, mi.Float(1), 0))
    # With a box filter, a sample on the border of its pixel belongs there.
    at = mi.Vector2f(position) if film.rfilter().is_box_filter() else place
    block.put(at, [*values, mi.Float(1), *further])


def _rgb(radiance: mi.Spectrum) -> tuple[mi.Float, mi.Float, mi.Float]:
    return tuple(radiance) if len(radiance) == 3 else (radiance[0],) * 3
