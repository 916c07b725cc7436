"""Equal-sample comparison of integrators on one scene, against a path traced reference."""

from __future__ import annotations

import statistics
import time
from pathlib import Path

import mitsuba as mi
import numpy as np

from compare.metrics import Picture, mean_bias, rel_mse
from compare.picture import write_comparison
from compare.records import Experiment, Measurements, Result
from compare.report import print_table, write_json
from envmap_integrator.cli.commands import activate_variant
from envmap_integrator.cli.output import replacing
from envmap_integrator.cli.scene_file import SceneFile
from envmap_integrator.cli.timing import compilation_time, measure, record_kernels
from envmap_integrator.progress import stage

REFERENCE_PART_SPP = 64
"""The reference is rendered in parts, so that memory is bounded and its spread is known."""

REFERENCE_SEED = 1_000_003
"""Far from the seeds of the measured runs: a shared seed would correlate their errors."""


def compare(experiment: Experiment, folder: Path) -> None:
    """Render, measure, and write pictures, a table and every number into ``folder``."""
    if experiment.runs < 3:
        raise ValueError(f"--runs must be at least 3 for a median, got {experiment.runs}")
    activate_variant(experiment.variant)
    folder.mkdir(parents=True, exist_ok=True)
    start = time.perf_counter()
    with record_kernels():
        measured = _measure(experiment)
    parts = _reference_parts(experiment)
    reference = np.mean(parts, axis=0)

    results = [_result(experiment, measurements, parts) for measurements in measured]
    base = folder / experiment.scene.stem
    for measurements in measured:
        name = f"{base.name}-{measurements.integrator}.exr"
        _write_exr(base.with_name(name), measurements.pictures[0])
    _write_exr(base.with_name(f"{base.name}-reference.exr"), reference)
    write_comparison(base.with_suffix(".png"), measured, reference)
    write_json(base.with_suffix(".json"), experiment, measured, results)
    print_table(experiment, results)
    print(f"wrote {base}*.exr, .png, .json in {time.perf_counter() - start:.0f} s")


def _measure(experiment: Experiment) -> list[Measurements]:
    """Compile everything, then let the integrators take turns: a machine slows all or none."""
    measured = [Measurements(name) for name in experiment.integrators]
    with stage("compilation", total=len(measured)) as advance:
        for measurements in measured:
            _warm_up(experiment, measurements)
            advance(1)
    with stage("timed runs", total=len(measured) * experiment.runs) as advance:
        for run in range(experiment.runs):
            for measurements in measured:
                _timed_run(experiment, experiment.seed + run, measurements)
                advance(1)
    return measured


def _load(experiment: Experiment, integrator: str) -> mi.Scene:
    """A fresh scene, nothing baked: film and path length are the same for all integrators."""
    scene_file = SceneFile(experiment.scene)
    limits = {}
    if integrator == "path":
        own = scene_file.integrator
        limits = {key: own[key] for key in ("max_depth", "hide_emitters") if key in own}
    scene_file.configure_integrator(integrator, limits)
    scene_file.configure_films(*experiment.size)
    return scene_file.load()


def _prepare(scene: mi.Scene) -> dict[str, float]:
    """Run the pre-passes, if the integrator has any; return the time of each stage [s]."""
    integrator = scene.integrator()
    return integrator.prepare(scene).stage_times if hasattr(integrator, "prepare") else {}


def _render(scene: mi.Scene, spp: int, seed: int) -> Picture:
    return np.array(mi.render(scene, spp=spp, seed=seed))[:, :, :3]


def _warm_up(experiment: Experiment, measurements: Measurements) -> None:
    """Compile all kernels. Sample counts that aren't powers of two have kernels of their own."""
    scene = _load(experiment, measurements.integrator)
    _prepare(scene)
    power_of_two = experiment.spp & (experiment.spp - 1) == 0
    _render(scene, 1 if power_of_two else experiment.spp, experiment.seed)
    measurements.settings = str(scene.integrator())
    measurements.compile_s = compilation_time()


def _timed_run(experiment: Experiment, seed: int, measurements: Measurements) -> None:
    """All that a user waits for once kernels are compiled, from a freshly loaded scene."""
    scene = _load(experiment, measurements.integrator)
    seconds: dict[str, float] = {}
    with measure(seconds, "prepare"):
        stages = _prepare(scene)
    with measure(seconds, "render"):
        picture = _render(scene, experiment.spp, seed)
    measurements.prepare_s.append(seconds["prepare"])
    measurements.render_s.append(seconds["render"])
    measurements.stages_s.append(stages)
    measurements.late_compile_s.append(compilation_time())
    measurements.seeds.append(seed)
    measurements.pictures.append(picture)


def _reference_parts(experiment: Experiment) -> list[Picture]:
    scene = _load(experiment, "path")
    part_spp = min(REFERENCE_PART_SPP, experiment.reference_spp)
    count = 2 * max(1, experiment.reference_spp // part_spp)
    parts = []
    with stage("reference", total=count) as advance:
        for index in range(count):
            parts.append(_render(scene, part_spp, REFERENCE_SEED + index))
            advance(1)
    return parts


def _result(experiment: Experiment, measurements: Measurements, parts: list[Picture]) -> Result:
    """Medians over the runs; the reference's even and odd parts are its independent halves."""
    half_a, half_b = np.mean(parts[::2], axis=0), np.mean(parts[1::2], axis=0)
    errors = [rel_mse(picture, half_a, half_b) for picture in measurements.pictures]
    totals = map(sum, zip(measurements.prepare_s, measurements.render_s, strict=True))
    return Result(
        integrator=measurements.integrator,
        spp=experiment.spp,
        prepare_s=statistics.median(measurements.prepare_s),
        render_s=statistics.median(measurements.render_s),
        total_s=statistics.median(totals),
        compile_s=measurements.compile_s,
        rel_mse=statistics.median(errors),
        rel_mse_runs=errors,
        bias=mean_bias(measurements.pictures, parts),
    )


def _write_exr(path: Path, picture: Picture) -> None:
    with replacing(path) as temporary:
        mi.Bitmap(picture.astype(np.float32)).write(str(temporary))
