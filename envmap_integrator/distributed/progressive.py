"""Pictures that get better, by the workers of a Dask cluster."""

from __future__ import annotations

import math
import os
from collections import deque
from collections.abc import Callable, Generator, Iterator, Mapping
from contextlib import closing
from pathlib import Path
from typing import Any

import mitsuba as mi
from distributed import Client

from ..imaging.film import Sums, n_pixels_of, pixel_ranges
from ..imaging.progressive import Improving, Pass, Renderer
from ..preparation.baked_state import BakedState
from ..system.checks import sensor_of
from . import worker
from .job import Job, View
from .render import (
    LEAST_SAMPLES,
    MOST_SAMPLES,
    PixelSums,
    check_parts,
    check_workers,
    count_workers,
    send_state,
)
from .tasks import TIME_LIMIT, results

#: Parts of pictures for each worker, with those that wait: so none waits for the last part of a
#: pass, nor for its picture.
PARTS_AHEAD = 2


def progressive_distributed(
    scene_file: str | Path,
    client: Client,
    *,
    integrator: str | None = None,
    settings: Mapping[str, Any] | None = None,
    parameters: Mapping[str, str] | None = None,
    sensor: int = 0,
    seed: int = 0,
    spp: int = 16,
    total: int = 256,
    seconds: float = math.inf,
    target_error: float = 0.0,
    progress_file: str | os.PathLike | None = None,
    resume: bool = False,
    time_limit: float = TIME_LIMIT,
) -> Iterator[Improving]:
    """Render a scene file in passes, by the workers of ``client``, while pictures are used.

    Pictures are to the bit what ``integrator.progressive`` gives in one process for the scene
    loaded with ``optimize=False``; see there and ``render_distributed`` for the rest.
    """
    job = Job.of(scene_file, parameters, integrator, settings)
    scene = job.load()
    return scene.integrator().progressive(
        scene,
        sensor,
        seed,
        spp,
        total,
        seconds=seconds,
        target_error=target_error,
        progress_file=progress_file,
        resume=resume,
        elsewhere=by_workers(client, job, scene, sensor, time_limit),
    )


def by_workers(
    client: Client, job: Job, scene: mi.Scene, sensor: int, time_limit: float = TIME_LIMIT
) -> Callable[[BakedState, int], Renderer]:
    """``elsewhere`` of ``integrator.progressive``, for a sensor of a job whose scene is loaded.

    Raises ``ValueError`` for integrators and workers that can't do it.
    """
    check_parts(scene.integrator())
    check_workers(client, job)
    n_pixels = n_pixels_of(sensor_of(scene, sensor).film())

    def elsewhere(baked: BakedState, planned: int) -> Renderer:
        state = send_state(client, baked)
        about = worker.state_digest(state), job, View(sensor)

        def render(passes: Iterator[Pass]) -> Generator[Sums]:
            calls: list[tuple] = []
            parts: list[tuple[PixelSums, range]] = []
            ahead: deque[PixelSums] = deque()

            def add() -> bool:
                """Call for the next pass, if there is one."""
                for _, seed, first, n in passes:
                    ahead.append(PixelSums(n_pixels))
                    samples = worker.Samples(seed, n, first, planned)
                    for pixels in _parts(n_pixels, n, count_workers(client)):
                        calls.append((*about, samples, pixels.start, pixels.stop))
                        parts.append((ahead[-1], pixels))
                    return True
                return False

            n_done = 0
            with closing(
                results(client, worker.render, calls, time_limit, lambda index: state)
            ) as found:
                while ahead or add():
                    while ahead[0].left:
                        while len(calls) - n_done < PARTS_AHEAD * count_workers(client) and add():
                            pass
                        index, sums = next(found)
                        n_done += 1
                        of_pass, pixels = parts[index]
                        of_pass.take(pixels, sums)
                    yield ahead.popleft().channels()

        return render

    return elsewhere


def _parts(n_pixels: int, spp: int, n_workers: int) -> list[range]:
    """Ranges of pixels of a pass: enough for all workers, but none is tiny or huge."""
    least, most = (max(n // spp, 1) for n in (LEAST_SAMPLES, MOST_SAMPLES))
    size = min(max(n_pixels // (PARTS_AHEAD * max(n_workers, 1)), least), most)
    return pixel_ranges(n_pixels, [min(size, n_pixels)] * -(-n_pixels // size))
