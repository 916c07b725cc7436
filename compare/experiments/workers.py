"""What it costs to spread a picture over workers, and how far that scales.

One process and local workers take turns at the same picture: times with all that the user waits
for, the start of the workers included; the pictures must be the same to the bit. Then many workers
that only sleep, for as long as such parts of a picture take, show what the scheduler leaves of
their time.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np
from distributed import Client, LocalCluster, get_worker

from compare.figures import plot
from compare.options import Options as CommonOptions
from compare.options import existing, option
from compare.report import Illustration, Report, Table
from compare.scenes import PAPER_ROOM, View
from envmap_integrator.distributed.cluster import local
from envmap_integrator.distributed.job import Job
from envmap_integrator.distributed.render import part_sizes, render_distributed
from envmap_integrator.distributed.tasks import results
from envmap_integrator.distributed.worker import Outcome
from envmap_integrator.system.progress import stage

SCENES = (PAPER_ROOM,)
INTEGRATOR = "envmap_hybrid"
#: Parts of a picture may cost so many times as much as others of the same size.
UNEVEN = 3.0
#: Calls that do nothing, to see how many a scheduler takes in a second.
EMPTY = 2000


@dataclass(frozen=True)
class Options(CommonOptions):
    """See ``--help``."""

    width: int = option("of the film, in pixels; its shape is the scene's own", 640, 96)
    runs: int = option("interleaved runs; at least 3", 3)
    spp: int = option("samples per pixel", 384, 64)
    workers: tuple[int, ...] = option("workers of one thread each", (1, 2))
    sleepers: tuple[int, ...] = option("workers that sleep", (1, 4, 16, 64), (1, 8))
    seconds: float = option("that each of these sleeps, in all", 30.0, 3.0)


def run(options: Options, folder: Path, scenes: tuple[Path, ...] = SCENES) -> Iterator[Report]:
    """One report a scene; nothing else is written to the folder."""
    for path in existing(scenes):
        yield _compare(View(path, options.width), options)


def _compare(view: View, options: Options) -> Report:
    width, height = view.size
    parameters = {"resx": str(width), "resy": str(height)}
    job = Job.of(view.path, parameters=parameters, integrator=INTEGRATOR)
    ways = [(False, n) for n in options.workers] + [(True, n) for n in options.workers]
    _picture(job, options, False, dr.thread_count())  # Compiles.
    times: dict[tuple[bool, int], list[float]] = {way: [] for way in ways}
    pictures = []
    with stage("timed runs", total=len(ways) * options.runs) as advance:
        for _ in range(options.runs):
            for way in ways:
                begin = time.perf_counter()
                pictures.append(_picture(job, options, *way))
                times[way].append(time.perf_counter() - begin)
                advance(1)
    same = all(np.array_equal(picture, pictures[0]) for picture in pictures)

    samples = width * height * options.spp
    rate = samples / statistics.median(times[False, options.workers[0]])
    simulated = [_simulate(n, options.seconds, rate) for n in options.sleepers]
    empty = _calls_per_second(max(options.sleepers))
    rows = [
        [_name(way), *map("{:.1f}".format, _spread(times[way])), _over(times, way)] for way in ways
    ]
    slept = [
        [f"{s['workers']}", f"{s['parts']}", f"{s['wall_s']:.1f}", f"{s['efficiency']:.1%}"]
        for s in simulated
    ]
    figure, (axes,) = plot()
    axes.plot(options.sleepers, [s["efficiency"] for s in simulated], marker="o")
    axes.set(xscale="log", xlabel="workers", ylabel="efficiency", ylim=(0, 1.02))
    return Report(
        name=f"workers-{view.name}",
        title=f"{view.name} by workers",
        settings=asdict(options) | {"scene": view, "integrator": INTEGRATOR},
        findings=[
            "All pictures are the same to the bit." if same else "The pictures DIFFER.",
            f"A scheduler takes {empty:.0f} calls a second, of workers in its own process.",
        ],
        tables=[
            Table("Times", ["by", "median [s]", "least", "greatest", "over one process"], rows),
            Table("Workers that sleep", ["workers", "parts", "wall time [s]", "efficiency"], slept),
        ],
        figures=[Illustration("efficiency", "Of workers that sleep.", figure)],
        numbers={
            "same": same,
            "times_s": {_name(way): seconds for way, seconds in times.items()},
            "simulated": simulated,
            "calls_per_second": empty,
        },
    )


def _name(way: tuple[bool, int]) -> str:
    by_workers, n = way
    return f"{n} worker(s) of one thread" if by_workers else f"one process, {n} thread(s)"


def _spread(seconds: list[float]) -> tuple[float, float, float]:
    return statistics.median(seconds), min(seconds), max(seconds)


def _over(times: dict[tuple[bool, int], list[float]], way: tuple[bool, int]) -> str:
    """What workers take more than one process of as many threads."""
    by_workers, n = way
    if not by_workers:
        return ""
    one, more = (statistics.median(times[kind, n]) for kind in (False, True))
    return f"{more - one:+.1f} s, {more / one - 1:+.1%}"


def _picture(job: Job, options: Options, by_workers: bool, n: int) -> np.ndarray:
    """From the scene file, by a process of ``n`` threads or by as many workers."""
    if by_workers:
        with local(n, n) as client:
            picture = render_distributed(
                job.scene, client, integrator=INTEGRATOR, parameters=job.parameters,
                spp=options.spp, seed=options.seed,
            )  # fmt: skip
            return np.array(picture)
    before = dr.thread_count()
    scene = job.load()
    dr.set_thread_count(n)
    try:
        picture = scene.integrator().render(scene, seed=options.seed, spp=options.spp)
        return np.array(picture)
    finally:
        dr.set_thread_count(before)


# ---------------------- Workers that sleep ----------------------


def _sleep(seconds: float) -> Outcome:
    time.sleep(seconds)
    return Outcome(get_worker().address, None)


def _simulate(n_workers: int, seconds: float, rate: float) -> dict[str, Any]:
    """Parts of a picture that take each of ``n_workers`` so long, at ``rate`` samples a second."""
    spp = 256
    n_pixels = int(n_workers * seconds * rate / spp)
    sizes = np.array([*part_sizes(n_pixels, n_pixels, spp, n_workers)])
    cost = np.random.default_rng(0).uniform(1, UNEVEN, len(sizes))
    cost *= sizes * spp / rate
    cost *= n_workers * seconds / cost.sum()
    with _sleepers(n_workers) as client:
        begin = time.perf_counter()
        done = sum(1 for _ in results(client, _sleep, [(float(c),) for c in cost]))
        wall = time.perf_counter() - begin
    efficiency = cost.sum() / (n_workers * wall)
    return {"workers": n_workers, "parts": done, "wall_s": wall, "efficiency": efficiency}


def _calls_per_second(n_workers: int) -> float:
    with _sleepers(n_workers) as client:
        begin = time.perf_counter()
        for _ in results(client, _sleep, [(0.0,)] * EMPTY):
            pass
        return EMPTY / (time.perf_counter() - begin)


@contextmanager
def _sleepers(n_workers: int) -> Iterator[Client]:
    """Workers that are threads of this process."""
    with (
        LocalCluster(
            n_workers=n_workers,
            threads_per_worker=1,
            processes=False,
            memory_limit=None,
            dashboard_address="127.0.0.1:0",
            worker_dashboard_address="127.0.0.1:0",
        ) as cluster,
        Client(cluster, set_as_default=False) as client,
    ):
        yield client
