"""Pictures that get better with every pass, and know how much noise is left in them."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from operator import add

import drjit as dr
import mitsuba as mi
import numpy as np

from ..system.interrupt import interruptible
from .film import Sums

#: Part of a picture's mean radiance, squared, that relMSE adds to the denominator.
DARK = 0.01


@dataclass(frozen=True)
class Improving:
    """A picture of all passes so far.

    picture   [H, W, C]  as Mitsuba's integrators give it
    spp       samples per pixel
    error     relMSE by the noise that is left in its radiance, infinite after a single pass; what
              cache and maps get wrong isn't part of it
    """

    picture: mi.TensorXf
    spp: int
    error: float


def improve(
    send: Callable[[int, int], Sums],
    develop: Callable[[Sums, int], mi.TensorXf],
    spp: int,
    total: int,
    deadline: float,
    target: float,
) -> Iterator[Improving]:
    """Render passes of ``spp`` samples per pixel, and give a picture when it's worth it.

    ``send(stream, index)`` renders pass ``index`` of one of two streams, which are independent of
    each other: how much their pictures differ tells the noise of both together. Within each, passes
    are well stratified together. ``develop(sums, n_samples)`` makes a picture and uses the list up.
    It ends after ``total`` samples per pixel, if another pass would take longer than to the
    ``deadline`` of ``time.perf_counter``, or with an error of at most ``target``.
    """
    streams: list[Sums | None] = [None, None]
    counts = [0, 0]
    n_passes, begin, last = 0, time.perf_counter(), False
    enough = math.inf
    while not last:
        stream = n_passes % 2
        with interruptible(), dr.suspend_grad():
            found = send(stream, counts[stream])
            so_far = streams[stream]
            streams[stream] = found if so_far is None else [*map(add, so_far, found)]
            dr.eval(streams[stream])
        counts[stream] += 1
        n_passes += 1
        now = time.perf_counter()
        last = n_passes * spp >= total or now + (now - begin) / n_passes > deadline
        if last or _worth_it(n_passes) or n_passes >= enough:
            with interruptible(), dr.suspend_grad():
                improving = _picture(streams, counts, develop, spp)
            last |= improving.error <= target
            yield improving
            if target > 0:  # Noise falls as the number of passes grows.
                enough = n_passes * improving.error / target


def _picture(streams, counts, develop, spp) -> Improving:
    n = sum(counts)
    if n == 1:
        return Improving(develop(list(streams[0]), spp), spp, math.inf)
    one, other = (
        np.array(develop(list(sums), count * spp))
        for sums, count in zip(streams, counts, strict=True)
    )
    picture = develop([*map(add, *streams)], n * spp)
    # A mean over passes has the variance of one, over their number.
    part = counts[0] * counts[1] / n**2
    return Improving(picture, n * spp, part * _rel_mse(one, other, np.array(picture)))


def _rel_mse(one: np.ndarray, other: np.ndarray, mean: np.ndarray) -> float:
    """Of the difference of two pictures [H, W, C], by their radiance."""
    one, other, mean = (picture[:, :, :3].astype(np.float64) for picture in (one, other, mean))
    square = np.square(one - other) / (np.square(mean) + DARK * mean.mean() ** 2)
    return float(square.mean())


def _worth_it(n: int) -> bool:
    """Is it a power of two, or half as much again?"""
    return n & (n - 1) == 0 or (n % 3 == 0 and (n // 3) & (n // 3 - 1) == 0)
