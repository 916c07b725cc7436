"""What runs on the workers."""

from __future__ import annotations

import asyncio
import hashlib
import os
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np
from distributed import Worker, get_worker

from ..system.atomic import replacing
from .job import Job, View

#: Environment variable with the number of threads of a worker; else it's one per core.
THREADS = "ENVMAP_WORKER_THREADS"

#: Mitsuba's variant and Dr.Jit's state belong to threads, and renders take all cores anyway.
_thread = ThreadPoolExecutor(max_workers=1)
#: The scene at hand.
_job: Job | None = None
_scene: mi.Scene | None = None


class Outcome(NamedTuple):
    """What a worker answers: a value, a fault that would meet the next one too, or that it lacks
    what it hasn't been sent yet.
    """

    worker: str
    value: Any
    fault: str = ""
    lacks: bool = False


def state_digest(state: bytes) -> str:
    """Content hash of a baked state's file."""
    return hashlib.blake2b(state, digest_size=16).hexdigest()


async def look(job: Job) -> str:
    """What is wrong with this worker; nothing if it can render."""
    return await asyncio.wrap_future(_thread.submit(_fault, job))


def receive(state: bytes, dask_worker: Worker) -> None:
    """Keep the file of a baked state, in the worker's own folder, which Dask removes."""
    path = _path(dask_worker, state_digest(state))
    if not path.exists():
        with replacing(path) as file:
            file.write(state)


class Samples(NamedTuple):
    """Samples of each pixel: see ``pixel_sums`` of the integrators."""

    seed: int
    spp: int
    first: int = 0
    planned: int = 0


def render(
    digest: str,
    job: Job,
    view: View,
    samples: Samples,
    begin: int,
    end: int,
    state: bytes | None = None,
) -> Outcome:
    """Sums over samples of the pixels ``begin … end`` of a view, [channels, pixels] float32.

    ``digest`` is the ``state_digest`` of the baked state; ``state`` is its file, for a worker that
    lacks it: it may have come later than the others.
    """
    worker = get_worker()
    if state is not None:
        receive(state, worker)
    path = _path(worker, digest)
    if not path.exists():
        return Outcome(worker.address, None, lacks=True)
    arguments = (worker.address, path, job, view, samples, range(begin, end))
    return _thread.submit(_render, *arguments).result()


def _fault(job: Job) -> str:
    try:
        return "" if job == _job else job.fault()
    except Exception as error:
        return _one_line(error)


def _render(address, state, job, view, samples, pixels) -> Outcome:
    try:
        fault = _fault(job)
        if fault:
            return Outcome(address, None, fault)
        scene = _opened(job)
        integrator = scene.integrator()
        integrator.cache_file = str(state)
        with view.of(scene) as sensor:
            seed, spp, first, planned = samples
            sums = integrator.pixel_sums(scene, sensor, seed, spp, pixels, first, planned)
        return Outcome(address, np.stack([value.numpy() for value in sums]))
    except MemoryError:  # Another worker may have more.
        raise
    except Exception as error:
        return Outcome(address, None, _one_line(error))


def _opened(job: Job) -> mi.Scene:
    global _job, _scene
    if job != _job:
        _job = _scene = None
        _scene = job.load()
        _job = job
        if THREADS in os.environ:
            dr.set_thread_count(int(os.environ[THREADS]))
    return _scene


def _path(worker: Worker, digest: str) -> Path:
    return Path(worker.local_directory) / f"state-{digest}.exr"


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__
