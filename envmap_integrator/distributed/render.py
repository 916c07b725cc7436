"""Renders whose pixels are spread over the workers of a Dask cluster."""

from __future__ import annotations

import asyncio
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from distributed import Client

from ..imaging.film import Sums, n_pixels_of, pixel_ranges
from ..lookup.irradiance_cache import IrradianceCache
from ..preparation.baked_state import BakedState
from ..system.interrupt import interruptible
from ..system.jit import upload
from ..system.progress import stage
from . import worker
from .job import Job, View
from .tasks import PATIENCE, TIME_LIMIT, ask_workers, results, workers_of

#: Samples of a part of a picture, at least and at most: half a second of a core, and 20 seconds.
#: Each part costs 0.05 s more.
LEAST_SAMPLES, MOST_SAMPLES = 1 << 19, 1 << 24
#: Every part is so much of what remains for each worker.
SHARE = 1 / 2


def render_distributed(
    scene_file: str | Path,
    client: Client,
    *,
    integrator: str | None = None,
    settings: Mapping[str, Any] | None = None,
    parameters: Mapping[str, str] | None = None,
    sensor: int = 0,
    spp: int = 0,
    seed: int = 0,
    time_limit: float = TIME_LIMIT,
) -> mi.TensorXf:
    """Render a scene file by the workers of ``client``, which find it under the same path.

    The picture is to the bit what ``integrator.render`` gives in one process for the scene loaded
    with ``optimize=False``, whatever the number of workers. ``integrator`` replaces the scene's,
    with ``settings`` as its parameters; ``parameters`` are values of ``$name`` in the scene file. A
    worker that gives no result for ``time_limit`` seconds is taken for hung.

    Raises ``ValueError`` as ``integrator.render`` does, and for workers that can't give the same
    picture; ``RuntimeError`` if workers fail again and again, or none is left.
    """
    (found,) = render_views(
        scene_file,
        client,
        [View(sensor)],
        integrator=integrator,
        settings=settings,
        parameters=parameters,
        spp=spp,
        seed=seed,
        time_limit=time_limit,
    )
    return found[1]


def render_views(
    scene_file: str | Path,
    client: Client,
    views: Sequence[View],
    *,
    integrator: str | None = None,
    settings: Mapping[str, Any] | None = None,
    parameters: Mapping[str, str] | None = None,
    spp: int = 0,
    seed: int = 0,
    time_limit: float = TIME_LIMIT,
) -> Iterator[tuple[int, mi.TensorXf]]:
    """As ``render_distributed``, for several views: index and picture of each, as they are done.

    They share a baked state where one serves them.
    """
    job = Job.of(scene_file, parameters, integrator, settings)
    yield from render_job(client, job, job.load(), views, spp, seed, time_limit)


def render_job(
    client: Client,
    job: Job,
    scene: mi.Scene,
    views: Sequence[View],
    spp: int = 0,
    seed: int = 0,
    time_limit: float = TIME_LIMIT,
) -> Iterator[tuple[int, mi.TensorXf]]:
    """Render views of a job whose ``scene`` is loaded here: index and picture, as they are done.

    The film of its sensor holds a picture when it comes. See ``render_distributed``.
    """
    check_parts(scene.integrator())
    check_workers(client, job)
    frames = _prepared(client, scene, views, spp)
    n_workers = count_workers(client)
    parts = []
    for index, frame in enumerate(frames):
        left = (len(frames) - index) * frame.n_pixels
        sizes = part_sizes(frame.n_pixels, left, frame.spp, n_workers)
        parts += [(index, pixels) for pixels in pixel_ranges(frame.n_pixels, sizes)]
    calls = []
    for index, pixels in parts:
        frame = frames[index]
        digest = worker.state_digest(frame.state)
        samples = worker.Samples(seed, frame.spp)
        calls.append((digest, job, frame.view, samples, pixels.start, pixels.stop))

    def state_of(call: int) -> bytes:
        return frames[parts[call][0]].state

    n_all = sum(frame.n_pixels for frame in frames)
    with stage("Rendering by workers", total=n_all) as advance:
        for call, sums in results(client, worker.render, calls, time_limit, state_of):
            index, pixels = parts[call]
            frames[index].sums.take(pixels, sums)
            advance(len(pixels))
            if frames[index].sums.left == 0:
                yield index, frames[index].picture(scene)


def _prepared(client: Client, scene: mi.Scene, views: Sequence[View], spp: int) -> list[_Frame]:
    """Views with their baked states, which the workers get."""
    frames = []
    known: dict[int, tuple[IrradianceCache, bytes]] = {}
    for view in views:
        with view.of(scene) as sensor:
            samples = spp or sensor.sampler().sample_count()
            baked = scene.integrator().prepare(scene, sensor, samples)
            n_pixels = n_pixels_of(sensor.film())
        cache = baked.cache  # States of views that share one differ in nothing that renders read.
        if id(cache) not in known:
            known[id(cache)] = cache, send_state(client, baked)
        frames.append(_Frame(view, samples, n_pixels, known[id(cache)][1]))
    return frames


def send_state(client: Client, baked: BakedState) -> bytes:
    """Send a baked state to all workers there are; returns its file."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "state.exr"
        baked.save(path)
        content = path.read_bytes()
    ask_workers(client, worker.receive, content)
    return content


def count_workers(client: Client) -> int:
    """Number of the workers that there are now."""
    return len(workers_of(client))


def check_parts(integrator: mi.Integrator) -> None:
    """Raise ``ValueError`` for an integrator that can't render some pixels alone."""
    if not hasattr(integrator, "pixel_sums"):
        raise ValueError(
            f"{type(integrator).__name__}: can't be rendered in parts; take envmap_hybrid, or one "
            "machine"
        )
    integrator.require_coherent("renders all pixels at once")


def check_workers(client: Client, job: Job) -> None:
    """Raise ``ValueError`` for the first worker that can't render, with what to do about it."""
    try:
        client.wait_for_workers(1, timeout=PATIENCE)
    except asyncio.TimeoutError:
        raise ValueError(
            f"{client.scheduler.address}: no worker has come within {PATIENCE:g} s; start some "
            "with: dask worker ADDRESS"
        ) from None
    for address, fault in ask_workers(client, worker.look, job).items():
        if "No module named 'envmap_integrator" in str(fault):
            fault = "has no package envmap_integrator; install it there"
        if fault and not isinstance(fault, OSError):  # Those have died; others are asked later.
            raise ValueError(f"worker {address}: {' '.join(str(fault).split())}")


class PixelSums:
    """The sums over the samples of all pixels, as they come.

    left    number of pixels that haven't come yet
    """

    def __init__(self, n_pixels: int):
        self.n_pixels = self.left = n_pixels
        self._sums: np.ndarray | None = None

    def take(self, pixels: range, sums: np.ndarray) -> None:
        """Sums [channels, pixels] of some pixels."""
        if self._sums is None:
            self._sums = np.zeros((len(sums), self.n_pixels), np.float32)
        self._sums[:, pixels.start : pixels.stop] = sums
        self.left -= len(pixels)

    def channels(self) -> Sums:
        """The sums of all pixels; they are used up."""
        channels, self._sums = self._sums, None
        return [upload(mi.Float, channel) for channel in channels]


class _Frame:
    """A view's picture; ``state`` is the file of the baked state."""

    def __init__(self, view: View, spp: int, n_pixels: int, state: bytes):
        self.view, self.spp, self.n_pixels, self.state = view, spp, n_pixels, state
        self.sums = PixelSums(n_pixels)

    def picture(self, scene: mi.Scene) -> mi.TensorXf:
        """The picture, also in the sensor's film; the sums are used up."""
        with self.view.of(scene) as sensor, interruptible(), dr.suspend_grad():
            scene.integrator().put(sensor, self.sums.channels(), self.spp)
            picture = sensor.film().develop()
            dr.eval(picture)
        return picture


def part_sizes(n_pixels: int, left: int, spp: int, n_workers: int) -> Iterator[int]:
    """Pixels of each part of a picture, of which and of those after it so many are ``left``.

    As in factoring (Hummel, Schonberg and Flynn 1992): parts shrink, so that workers end together.
    """
    least, most = (max(n // spp, 1) for n in (LEAST_SAMPLES, MOST_SAMPLES))
    while n_pixels > 0:
        size = min(max(int(SHARE * left / n_workers), least), most, n_pixels)
        yield size
        n_pixels -= size
        left -= size
