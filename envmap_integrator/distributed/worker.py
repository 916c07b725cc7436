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
from distributed import get_worker

from .job import Job, View

#: Environment variable with the number of threads of a worker; else it's one per core.
THREADS = "ENVMAP_WORKER_THREADS"

#: Mitsuba's variant and Dr.Jit's state belong to threads, and renders take all cores anyway.
_thread = ThreadPoolExecutor(max_workers=1)
#: The scene at hand.
_job: Job | None = None
_scene: mi.Scene | None = None


class Outcome(NamedTuple):
    """What a worker answers: a value, or a fault that would meet the next one too."""

    worker: str
    value: Any
    fault: str = ""


def state_digest(state: bytes) -> str:
    """Content hash of a baked state's file."""
    return hashlib.blake2b(state, digest_size=16).hexdigest()


def keep(state: bytes) -> bytes:
    """The content of a baked state's file, as a task: workers get it from each other, and anew if
    those who had it have died.
    """
    return state


async def look(job: Job) -> str:
    """What is wrong with this worker; nothing if it can render."""
    return await asyncio.wrap_future(_thread.submit(_fault, job))


def render(
    state: bytes, digest: str, job: Job, view: View, seed: int, spp: int, begin: int, end: int
) -> Outcome:
    """Sums over the samples of the pixels ``begin … end`` of a view, [channels, pixels] float32.

    ``state`` is the file of the baked state, ``digest`` its ``state_digest``.
    """
    worker = get_worker()
    arguments = (Path(worker.local_directory), state, digest, job, view, seed, spp)
    return _thread.submit(_render, worker.address, *arguments, range(begin, end)).result()


def _fault(job: Job) -> str:
    try:
        return "" if job == _job else job.fault()
    except Exception as error:
        return _one_line(error)


def _render(address, folder, state, digest, job, view, seed, spp, pixels) -> Outcome:
    try:
        fault = _fault(job)
        if not fault and state_digest(state) != digest:
            fault = "got a damaged baked state; check its network"
        if fault:
            return Outcome(address, None, fault)
        scene = _opened(job)
        integrator = scene.integrator()
        integrator.cache_file = str(_stored(folder, state, digest))
        with view.of(scene) as sensor:
            sums = integrator.pixel_sums(scene, sensor, seed, spp, pixels)
        return Outcome(address, np.stack([value.numpy() for value in sums]))
    except MemoryError:  # Another worker may have more.
        raise
    except Exception as error:
        return Outcome(address, None, _one_line(error))


def _opened(job: Job) -> mi.Scene:
    global _job, _scene
    if job != _job:
        _job = _scene = None
        # With a single thread, Mitsuba may wait for ever for what it loads in parallel.
        dr.set_thread_count(max(dr.thread_count(), 2))
        _scene = job.load()
        _job = job
        if THREADS in os.environ:
            dr.set_thread_count(int(os.environ[THREADS]))
    return _scene


def _stored(folder: Path, state: bytes, digest: str) -> Path:
    """A file with the baked state in the worker's own folder, which Dask removes."""
    path = folder / f"state-{digest}.exr"
    if not path.exists():
        path.write_bytes(state)
    return path


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__
