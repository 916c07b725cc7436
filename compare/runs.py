"""Timed runs: integrators take turns, and compilation is kept apart.

Sample counts and film sizes are literals in Mitsuba's kernels, so each task compiles its own. The
first run of a task does; the time that Dr.Jit spent on it is taken out of that run.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import mitsuba as mi
import numpy as np

from compare.metrics import Picture
from compare.scenes import PATH, Subject
from envmap_integrator.cli.timing import compilation_time, measure, record_kernels
from envmap_integrator.imaging.denoiser import denoise, prepare_for_denoiser, warm_up
from envmap_integrator.system.progress import stage


@dataclass(frozen=True)
class Task:
    """One integrator on one scene with one sample count; ``denoise`` adds a denoised picture."""

    scene: mi.Scene
    subject: Subject
    spp: int
    denoise: bool = False


@dataclass(frozen=True)
class Run:
    """What one timed run gave; ``_s`` are seconds.

    prepare_s       pre-passes, all stages
    stages_s        each of their stages, compilation included
    render_s        the picture itself
    denoise_s       guide images and denoiser, 0 without
    compile_s       compilation of kernels, which the other times leave out
    """

    seed: int
    prepare_s: float
    stages_s: dict[str, float]
    render_s: float
    denoise_s: float
    compile_s: float
    picture: Picture = field(repr=False)
    denoised: Picture | None = field(default=None, repr=False)

    @property
    def total_s(self) -> float:
        """All that the user of the noisy picture waits for."""
        return self.prepare_s + self.render_s

    def numbers(self) -> dict[str, object]:
        """All but the pictures."""
        return {k: v for k, v in vars(self).items() if k not in ("picture", "denoised")}


@dataclass
class Measurements:
    """All runs of one task."""

    subject: Subject
    spp: int
    settings: str = ""
    runs: list[Run] = field(default_factory=list)

    def median(self, quantity: str) -> float:
        """Of ``prepare_s``, ``render_s``, ``denoise_s`` or ``total_s`` over the runs."""
        return statistics.median(getattr(run, quantity) for run in self.runs)

    def total_s(self) -> float:
        """Median of preparation and rendering together."""
        return self.median("total_s")

    def spread(self, quantity: str) -> tuple[float, float]:
        """Least and greatest of the runs."""
        values = [getattr(run, quantity) for run in self.runs]
        return min(values), max(values)

    def compile_s(self) -> float:
        """Seconds of compilation before this task's kernels were all in the cache."""
        return sum(run.compile_s for run in self.runs)

    def stage_medians(self) -> dict[str, float]:
        """Median seconds of each stage of the pre-passes."""
        return {
            name: statistics.median(run.stages_s[name] for run in self.runs)
            for name in self.runs[0].stages_s
        }

    def pictures(self) -> list[Picture]:
        """One a run."""
        return [run.picture for run in self.runs]

    def numbers(self) -> dict[str, object]:
        """For the JSON file."""
        return {
            "subject": self.subject.name,
            "integrator": self.subject.integrator,
            "spp": self.spp,
            "settings": self.settings,
            "compile_s": self.compile_s(),
            "runs": [run.numbers() for run in self.runs],
        }


def interleave(
    tasks: Sequence[Task],
    n_runs: int,
    seed: int,
    hide_emitters: bool = False,
    each: Callable[[Measurements], None] = lambda measurements: None,
) -> list[Measurements]:
    """Let the tasks take turns, ``n_runs`` times: a machine slows all of them or none.

    Run ``i`` of every task has the seed ``seed + i``. Each run has a preparation of its own, which
    counts: what is prepared depends on the samples. After it, ``each`` gets what its task has so
    far.
    """
    measured = [Measurements(task.subject, task.spp) for task in tasks]
    for task in tasks:
        if task.denoise:
            warm_up(*task.scene.sensors()[0].film().crop_size())
    with record_kernels(), stage("timed runs", total=len(tasks) * n_runs) as advance:
        for index in range(n_runs):
            for task, measurements in zip(tasks, measured, strict=True):
                integrator = task.subject.make(hide_emitters)
                if task.denoise:
                    prepare_for_denoiser(integrator)
                measurements.settings = str(integrator)
                measurements.runs.append(_timed_run(task, integrator, seed + index))
                each(measurements)
                advance(1)
    return measured


def equal_time_spp(
    task: Task,
    pilot_spp: int,
    seed: int,
    hide_emitters: bool = False,
    each: Callable[[Measurements], None] = lambda measurements: None,
) -> int:
    """Samples per pixel of ``path`` that fit into the time of a task, by two pilot runs.

    ``pilot_spp`` are those of the pilot of ``path``. Samplers that stratify round up to full grids,
    so the number is one of a nearly square grid. ``each`` is that of ``interleave``.
    """
    pilots = [task, Task(task.scene, PATH, pilot_spp)]
    ours, path = interleave(pilots, 2, seed, hide_emitters, each)
    spp = max(round(pilot_spp * ours.runs[1].total_s / path.runs[1].total_s), 1)
    rows = math.isqrt(spp)
    return rows * round(spp / rows)


def _timed_run(task: Task, integrator: mi.Integrator, seed: int) -> Run:
    """All that a user waits for, compilation apart."""
    seconds: dict[str, float] = {}
    stages: dict[str, float] = {}
    denoised = None
    compilation_time()  # what came before isn't ours
    with measure(seconds, "prepare"):
        if hasattr(integrator, "prepare"):
            stages = dict(integrator.prepare(task.scene, spp=task.spp).stage_times)
    prepare_compile_s = compilation_time()
    with measure(seconds, "render"):
        channels = _channels(task.scene, integrator, task.spp, seed)
    render_compile_s = compilation_time()
    with measure(seconds, "denoise"):
        if task.denoise:
            denoised = denoise(task.scene, integrator, channels, task.spp, seed)
    denoise_compile_s = compilation_time()
    return Run(
        seed=seed,
        prepare_s=seconds["prepare"] - prepare_compile_s,
        stages_s=stages,
        render_s=seconds["render"] - render_compile_s,
        denoise_s=seconds["denoise"] - denoise_compile_s if task.denoise else 0.0,
        compile_s=prepare_compile_s + render_compile_s + denoise_compile_s,
        picture=channels[:, :, :3].copy(),
        denoised=denoised,
    )


def render(scene: mi.Scene, integrator: mi.Integrator, spp: int, seed: int) -> Picture:
    """Radiance, [H, W, 3]."""
    return _channels(scene, integrator, spp, seed)[:, :, :3]


def _channels(scene: mi.Scene, integrator: mi.Integrator, spp: int, seed: int) -> np.ndarray:
    """Radiance, then whatever else the integrator gives, [H, W, C]."""
    return np.array(mi.render(scene, integrator=integrator, spp=spp, seed=seed))
