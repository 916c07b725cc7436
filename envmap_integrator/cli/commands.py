"""The commands ``render``, ``bake`` and ``inspect``."""

from __future__ import annotations

import argparse
import json
import math
import time
from contextlib import ExitStack
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
from rich.console import Console
from rich.table import Table

import envmap_integrator
from envmap_integrator.cli import workers
from envmap_integrator.cli.output import write_bitmap, write_png
from envmap_integrator.cli.timing import compilation_time, measure, record_kernels
from envmap_integrator.imaging.denoiser import denoise, prepare_for_denoiser, warm_up
from envmap_integrator.imaging.film import has_bands
from envmap_integrator.imaging.progressive import Improving
from envmap_integrator.inspection import page
from envmap_integrator.system.atomic import check_writable
from envmap_integrator.system.checks import check_size, sensor_of
from envmap_integrator.system.llvm import ensure_llvm
from envmap_integrator.system.printed import plain, printed
from envmap_integrator.system.progress import stage
from envmap_integrator.system.scene_file import DEFAULT_INTEGRATOR, SceneFile


def render(args: argparse.Namespace) -> int:
    """Render one sensor; write the picture with its settings and stage times in its header."""
    output = args.output or args.scene.with_suffix(".exr")
    check_output(output, hint=" (--png adds a PNG)")
    _require(args.spp >= 0, f"--spp must not be negative, got {args.spp}")
    _require(not args.tls or args.cluster is not None, "--tls is for --cluster: leave it out")
    _configure_machine(args)
    seconds: dict[str, float] = {}
    with record_kernels():
        # Merged meshes have another order in each process.
        scene_file, scene = _load(args, seconds, merge_meshes=not _by_workers(args))
        sensor = _sensor(args, scene)
        _require(
            not (has_bands(sensor.film()) and (args.denoise or args.png)),
            "--denoise and --png need colour, the film holds bands: leave them out, or take a "
            "hdrfilm",
        )
        settings = _settings(args, scene_file, scene, sensor)
        more: dict[str, float] = {}
        with ExitStack() as stack:
            asked = args, scene, sensor, settings, seconds, more, stack
            bitmap = _improve(*asked, output) if _improves(args) else _render_at_once(*asked)
        compilation = compilation_time()
    _write(args, output, bitmap, settings, seconds, compilation, more)
    _report(args, seconds, compilation, output, **more, settings=settings)
    if not (args.quiet or args.json):
        if args.png:
            print(f"wrote {output.with_suffix('.png')}")
        print(f"by {settings['integrator']} with {settings['spp']} samples a pixel")
    return 0


def _improves(args: argparse.Namespace) -> bool:
    """Are pictures asked for that get better?"""
    ends = args.time is not None or args.target_error is not None
    return args.progressive or args.resume or ends


def _by_workers(args: argparse.Namespace) -> bool:
    """Are other processes to render?"""
    return args.workers is not None or args.cluster is not None


def _render_at_once(args, scene, sensor, settings, seconds, more, stack) -> mi.Bitmap:
    integrator = scene.integrator()
    for_denoiser = args.denoise and prepare_for_denoiser(integrator)
    if args.denoise:  # Fails before the work starts, if there is no denoiser.
        warm_up(*sensor.film().crop_size())
    render = integrator.render
    if _by_workers(args):
        with measure(seconds, "find workers"):
            render = workers.renderer(args, stack)
    if hasattr(integrator, "prepare"):
        state = integrator.prepare(scene, sensor, args.spp)
        seconds |= state.stage_times
        more["cache_error"] = state.relative_error
    with measure(seconds, "render"):
        # Not mi.render, which would make another exception of Ctrl-C.
        dr.eval(render(scene, sensor, seed=args.seed, spp=args.spp))
    bitmap = sensor.film().bitmap()
    if args.denoise:
        with measure(seconds, "denoise"):
            _denoise(bitmap, scene, settings)
    if for_denoiser:
        _, bitmap = bitmap.split()[0]
    return bitmap


#: Samples per pixel of a pass, and at most if only time or error end it.
PASS, MOST = 16, 4096


def _improve(args, scene, sensor, settings, seconds, more, stack, output) -> mi.Bitmap:
    """Write pictures that get better, until the samples, the time or the error asked for."""
    integrator = scene.integrator()
    _require(
        hasattr(integrator, "progressive"),
        f'integrator "{settings["integrator"]}" can\'t go on where it ended: pass --integrator '
        "envmap_hybrid, or leave out --progressive, --time and --target-error",
    )
    _require(
        not args.denoise,
        "--denoise takes one picture: leave out --progressive, --time and --target-error",
    )
    elsewhere = None
    if _by_workers(args):
        with measure(seconds, "find workers"):
            elsewhere = workers.pass_renderer(args, stack, scene)
    asked = args.time is not None or args.target_error is not None
    total = args.spp or (MOST if asked else settings["spp"])
    begin = time.perf_counter()
    keeps = args.progressive or args.resume
    pictures = integrator.progressive(
        scene,
        sensor,
        args.seed,
        PASS,
        total,
        seconds=math.inf if args.time is None else args.time,
        target_error=args.target_error or 0.0,
        progress_file=output.with_suffix(".progress.exr") if keeps else None,
        resume=args.resume,
        elsewhere=elsewhere,
        planned=settings["spp"] if args.time else 0,  # How many there is time for, nobody knows.
    )
    for better in pictures:
        elapsed = time.perf_counter() - begin
        seconds |= better.state.stage_times
        seconds["render"] = elapsed - sum(better.state.stage_times.values())
        more["cache_error"] = better.state.relative_error
        settings["spp"] = better.spp
        if math.isfinite(better.error):
            more["noise_error"] = better.error
        bitmap = sensor.film().bitmap()
        if args.progressive and not better.is_last:
            _write(args, output, bitmap, settings, seconds, 0.0, more)
        if not (args.quiet or args.json):
            print(_progress(better, elapsed, args, total), flush=True)
    return bitmap


def _progress(better: Improving, elapsed: float, args: argparse.Namespace, total: int) -> str:
    """What there is so far, and how long it may take."""
    left = [better.pace * (total - better.spp)]
    if args.time:
        left.append(args.time - elapsed)
    if args.target_error and math.isfinite(better.error):
        left.append(better.pace * better.spp * (better.error / args.target_error - 1))
    noise = f"noise {better.error:.1e}" if math.isfinite(better.error) else "noise unknown"
    time_left = f"about {max(min(left), 0):.0f} s left"
    if better.is_last:
        time_left = "about 0 s left"
    elif not better.pace:
        time_left = "kept from before"
    elif math.isinf(better.error):  # A single pass, which may have compiled kernels.
        time_left = time_left.replace("about", "at most")
    return f"{better.spp} samples per pixel, {noise}, {elapsed:.1f} s; {time_left}"


def _write(args, output, bitmap, settings, seconds, compilation, more) -> None:
    metadata = bitmap.metadata()
    metadata["envmap_integrator"] = envmap_integrator.__version__
    metadata["settings"] = json.dumps(settings)
    metadata["stage_times"] = json.dumps(seconds)
    metadata["compilation_time"] = compilation
    for name, value in more.items():
        metadata[name] = value
    write_bitmap(output, bitmap)
    if args.png:
        write_png(output.with_suffix(".png"), bitmap)


def _denoise(bitmap: mi.Bitmap, scene: mi.Scene, settings: dict[str, object]) -> None:
    """Denoise the radiance channels of ``bitmap`` in place."""
    pixels = np.array(bitmap, copy=False)
    _, radiance = bitmap.split()[0]
    _require(
        radiance.channel_count() >= 3,
        f"--denoise needs colour, the film has {radiance.channel_count()} channel(s): set its "
        '"pixel_format" to rgb or rgba',
    )
    spp, seed, sensor = (settings[key] for key in ("spp", "seed", "sensor"))
    pixels[:, :, :3] = denoise(scene, scene.integrator(), pixels, spp, seed, sensor)


#: Integrators that there is something to see of.
INSPECTED = ("envmap_hybrid", "one_level_path")


def bake(args: argparse.Namespace) -> int:
    """Run the integrator's pre-passes alone and save their result, or bake some maps of it anew."""
    check_output(args.output)
    _configure_machine(args)
    seconds: dict[str, float] = {}
    with record_kernels():
        scene_file, scene = _load(args, seconds, merge_meshes=False)
        name = scene_file.integrator.plugin_name()
        _require(
            hasattr(scene.integrator(), "prepare"),
            f'integrator "{name}" has nothing to bake: pass --integrator envmap_hybrid',
        )
        if args.clusters is None:
            state = scene.integrator().prepare(scene)
        else:
            _require(
                hasattr(scene.integrator(), "rebake"),
                f'--clusters: integrator "{name}" has none; pass --integrator envmap_hybrid',
            )
            names = [each.strip() for each in args.clusters.split(",")]
            state = scene.integrator().rebake(scene, args.output, names)
        seconds |= state.stage_times
        compilation = compilation_time()
    state.save(args.output)
    maps = {m.cluster.name: m.resolution for m in state.maps}
    _report(args, seconds, compilation, args.output, maps=maps)
    if maps and not (args.quiet or args.json):
        listed = ", ".join(f"{name} ({n} x {n})" for name, n in maps.items())
        print(f"maps: {listed}")
    return 0


def inspect(args: argparse.Namespace) -> int:
    """Write a page that shows what was prepared for a picture, and what its rays do."""
    output = args.output or args.scene.with_suffix(".html")
    check_output(output, ".html")
    _require(args.spp >= 0, f"--spp must not be negative, got {args.spp}")
    _configure_machine(args)
    seconds: dict[str, float] = {}
    with record_kernels():
        with measure(seconds, "load"), stage("Loading the scene"):
            scene_file = SceneFile(args.scene, dict(args.define))
            ours = scene_file.integrator.plugin_name() in INSPECTED
            name = args.integrator or (None if ours else DEFAULT_INTEGRATOR)
            _require(
                name in (None, *INSPECTED),
                f'integrator "{name}" has nothing to inspect: pass --integrator envmap_hybrid',
            )
            scene_file.configure_integrator(name, dict(args.set) | {"sampler": "coherent"})
            scene = scene_file.load(merge_meshes=False)  # Shapes keep their names.
        sensor = _sensor(args, scene)
        settings = _settings(args, scene_file, scene, sensor)
        with measure(seconds, "survey and page"):
            page.inspect(
                output, scene, sensor=sensor, spp=args.spp, seed=args.seed, settings=settings
            )
        compilation = compilation_time()
    _report(args, seconds, compilation, output, settings=settings)
    return 0


def activate_variant(name: str) -> None:
    """``mi.set_variant``, with an error before Dr.Jit meets a libLLVM that would abort it."""
    variants = mi.variants()
    _require(name in variants, f'unknown variant "{name}": choose from {", ".join(variants)}')
    if name.startswith("llvm_"):
        ensure_llvm()
    mi.set_variant(name)


def _configure_machine(args: argparse.Namespace) -> None:
    activate_variant(args.mode)
    if args.threads is not None:
        _require(args.threads >= 1, f"-t/--threads must be at least 1, got {args.threads}")
        dr.set_thread_count(args.threads)


def _load(
    args: argparse.Namespace, seconds: dict[str, float], merge_meshes: bool = True
) -> tuple[SceneFile, mi.Scene]:
    with measure(seconds, "load"), stage("Loading the scene"):
        scene_file = SceneFile(args.scene, dict(args.define))
        scene_file.configure_integrator(args.integrator, dict(args.set))
        if getattr(args, "denoise", False):
            scene_file.configure_reconstruction_filters("box")
        return scene_file, scene_file.load(merge_meshes)


def _sensor(args: argparse.Namespace, scene: mi.Scene) -> mi.Sensor:
    """The one that is asked for; Mitsuba's integrators don't say that its picture is empty."""
    sensor = sensor_of(scene, args.sensor)
    check_size(sensor, args.spp)
    return sensor


def _settings(
    args: argparse.Namespace, scene_file: SceneFile, scene: mi.Scene, sensor: mi.Sensor
) -> dict[str, object]:
    """Everything needed to repeat the picture, defaults resolved."""
    return {
        "scene": str(args.scene),
        "defines": dict(args.define),
        "variant": args.mode,
        "sensor": args.sensor,
        "spp": args.spp or sensor.sampler().sample_count(),
        "seed": args.seed,
        "denoised": args.denoise,
        "integrator": scene_file.integrator.plugin_name(),
        "integrator_settings": {n: plain(text) for n, text in printed(scene.integrator()).items()},
    }


def check_output(path: Path, suffix: str = ".exr", hint: str = "") -> None:
    """Fail before the work starts rather than after it."""
    _require(path.suffix == suffix, f'output "{path}" must end in {suffix}{hint}')
    check_writable(path)


def _require(condition: bool, message: str) -> None:
    if not condition:
        raise ValueError(message)


def _report(
    args: argparse.Namespace, seconds: dict[str, float], compilation: float, output: Path, **more
) -> None:
    """Say what has been done, as a table or, with ``more`` of it, as JSON."""
    if args.quiet:
        return
    seconds = seconds | {"total": sum(seconds.values())}
    if args.json:
        result = {"output": str(output), "seconds": seconds, "compilation_s": compilation} | more
        print(json.dumps(result))
        return
    table = Table("stage", "seconds", box=None)
    table.columns[1].justify = "right"
    for name, duration in seconds.items():
        table.add_row(name, f"{duration:.2f}", style="bold" if name == "total" else "")
    table.add_row("of it compiling kernels", f"{compilation:.2f}", style="dim")
    console = Console()
    console.print(table)
    console.print(f"wrote {output}", highlight=False, soft_wrap=True)
