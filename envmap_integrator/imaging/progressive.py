"""Pictures that get better with every pass, and know how much noise is left in them."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass
from operator import add
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.ndimage import rank_filter

from ..system.interrupt import interruptible
from .film import Sums
from .progress_file import Progress, Stream

#: Part of a picture's mean radiance, squared, that relMSE adds to the denominator.
DARK = 0.01
#: Of a pixel [H, W, C].
_NEIGHBOURS = np.ones((3, 3, 1), bool)
_NEIGHBOURS[1, 1] = False


@dataclass(frozen=True)
class Improving:
    """A picture of all passes so far.

    picture   [H, W, C]  as Mitsuba's integrators give it
    spp       samples per pixel
    error     relMSE by the noise that is left in its radiance, infinite after a single pass; what
              cache and maps get wrong isn't part of it
    pace      seconds that a sample of all pixels takes, 0 if there is nothing to do; after a single
              pass, with the compilation of kernels
    is_last   whether no other comes
    state     the ``BakedState`` that it's rendered with
    """

    picture: mi.TensorXf
    spp: int
    error: float
    pace: float
    is_last: bool
    state: Any


class Pass(NamedTuple):
    """Samples of all pixels.

    stream   index of the stream that they belong to, of two
    seed     of that stream
    first    index in it of the first sample of each pixel
    n        samples per pixel
    """

    stream: int
    seed: int
    first: int
    n: int


#: Renders passes: sums over the samples of each, in order. It may begin with the next ones while
#: those of one are used.
Renderer = Callable[[Iterator[Pass]], Generator[Sums]]


def check_ends(owner: str, spp: int, total: int, seconds: float, target_error: float) -> None:
    """Raise ``ValueError`` for passes without samples, and for ends that are there at once."""
    for name, value in (("spp", spp), ("total", total)):
        if value < 1:
            raise ValueError(f'{owner}: "{name}" must be at least 1, not {value}')
    if not seconds > 0:
        raise ValueError(f'{owner}: "seconds" or --time must be above 0, not {seconds}')
    if not target_error >= 0:
        raise ValueError(
            f'{owner}: "target_error" or --target-error must be above 0 or left out, not '
            f"{target_error}"
        )


def improve(
    render: Renderer,
    develop: Callable[[Sums, int], mi.TensorXf],
    keep: Callable[[], None],
    progress: Progress,
    seed: int,
    spp: int,
    total: int,
    deadline: float,
    target: float,
    state: Any,
) -> Iterator[Improving]:
    """Render passes of ``spp`` samples per pixel, and give a picture when it's worth it.

    They belong to two streams by turns, which are independent of each other: how much their
    pictures differ tells the noise of both together. Within each, passes are well stratified
    together. ``develop(sums, n_samples)`` makes a picture and uses the list up. ``progress`` is
    what there is so far, and is brought up to date; ``keep()`` is called for every picture, and on
    Ctrl-C.

    It ends after ``total`` samples per pixel, if another pass would take longer than to the
    ``deadline`` of ``time.perf_counter``, or with an error of at most ``target``.
    """
    # Pace is counted from here, and from the end of the first pass on, which may compile kernels.
    begin, n_begin = time.perf_counter(), progress.samples
    n_before, pace, enough = n_begin, 0.0, math.inf
    due, last = n_before > 0, n_before >= total  # What there is already is shown at once.
    plan = passes(progress, seed, spp, total)
    rendered = render(passes(progress, seed, spp, total))
    try:
        while True:
            if due:
                with interruptible(), dr.suspend_grad():
                    picture, error = _picture(progress.streams, develop)
                last |= error <= target
                keep()
                yield Improving(picture, progress.samples, error, pace, last, state)
                if target > 0:  # Noise falls as the number of samples grows.
                    enough = progress.samples * error / target
            if last:
                return
            _take(next(plan), rendered, progress)
            now = time.perf_counter()
            pace = (now - begin) / (progress.samples - n_begin)
            if n_begin == n_before:
                begin, n_begin = now, progress.samples
            last = progress.samples >= total or now + pace * spp > deadline
            due = last or _worth_it(-(-progress.samples // spp)) or progress.samples >= enough
    except KeyboardInterrupt:
        if progress.samples:
            keep()
        raise
    finally:
        rendered.close()


def passes(progress: Progress, seed: int, spp: int, total: int) -> Iterator[Pass]:
    """All passes from what there is to ``total`` samples per pixel.

    Each is of the stream that has fewer samples then; one that was cut short is filled up.
    """
    samples = [stream.samples for stream in progress.streams]
    while (left := total - sum(samples)) > 0:
        index = int(samples[1] < samples[0])
        n = min(spp - samples[index] % spp, left)
        yield Pass(index, 2 * seed + index & 0xFFFFFFFF, samples[index], n)
        samples[index] += n


def _take(due: Pass, rendered: Iterator[Sums], progress: Progress) -> None:
    """Add the next pass to the stream that it belongs to."""
    so_far = progress.streams[due.stream]
    with interruptible(), dr.suspend_grad():
        sums = next(rendered)
        if so_far.samples:
            sums = [*map(add, so_far.sums, sums)]
        dr.eval(sums)
    # At once: Ctrl-C may come between any two steps.
    progress.streams[due.stream] = Stream(sums, so_far.samples + due.n)


def _picture(streams: list[Stream], develop) -> tuple[mi.TensorXf, float]:
    """The picture of both streams, and its error."""
    (one, n_one), (other, n_other) = ((stream.sums, stream.samples) for stream in streams)
    if n_other == 0:
        return develop(list(one), n_one), math.inf
    first, second = np.array(develop(list(one), n_one)), np.array(develop(list(other), n_other))
    picture = develop([*map(add, one, other)], n_one + n_other)
    # A mean over samples has the variance of one, over their number.
    part = n_one * n_other / (n_one + n_other) ** 2
    return picture, part * _rel_mse(first, second, np.array(picture))


def _rel_mse(one: np.ndarray, other: np.ndarray, mean: np.ndarray) -> float:
    """Of the difference of two pictures [H, W, C], by their radiance.

    A single bright sample mustn't hide its own error behind the brightness that it makes: a pixel
    counts as no brighter than the second of its neighbours.
    """
    one, other, mean = (picture[:, :, :3].astype(np.float64) for picture in (one, other, mean))
    scale = np.minimum(mean, rank_filter(mean, -2, footprint=_NEIGHBOURS))
    square = np.square(one - other) / (np.square(scale) + DARK * mean.mean() ** 2)
    return float(square.mean())


def _worth_it(n: int) -> bool:
    """Is it a power of two, or half as much again?"""
    return n & (n - 1) == 0 or (n % 3 == 0 and (n // 3) & (n // 3 - 1) == 0)
