"""Flicker of what stands still while the camera or a shape moves, beside path at equal samples.

The camera turns about the point that it looks at, or a shape moves past it. In each frame, averages
over tiles are off from those of a reference of the same frame, by noise and by what cache and maps
get wrong; flicker is how much that changes from frame to frame. An error that stays the same isn't
seen as flicker. Where a shape moves, only pixels count that see neither it nor its shadow, and
frames are rendered with the same seed too: then path changes only by what its paths find of it.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from compare import moving
from compare.figures import COLUMNS, panels, plot
from compare.metrics import REL_MSE_EPSILON, Estimate, estimate, tiles
from compare.options import JudgedOptions, existing, option
from compare.report import Illustration, Report, Table
from compare.scenes import HYBRID, OWN_SCENES, PATH, View
from envmap_integrator.system.progress import stage

SCENES = (OWN_SCENES / "desk.xml",)

TILE = 8
"""Width of a tile [pixels]: the eye sees the flicker of areas, not of pixels."""

SHARED, ALONE = HYBRID.name, f"{HYBRID.name}, each frame prepared alone"
SAME_SEED = "the same seed"

Frames = NDArray[np.float32]
"""Pictures of all frames, [F, H, W, 3]."""


@dataclass(frozen=True)
class Options(JudgedOptions):
    """See ``--help``."""

    width: int = option("of the film, in pixels; its shape is the scene's own", 128, 96)
    runs: int = option("times that all is rendered, with other seeds; at least 3", 3)
    reference_spp: int = option("samples per pixel of each of two references of a frame", 64)
    frames: int = option("of the camera's way, at least 2", 60, 8)
    degrees: float = option("by which the camera turns in all", 20.0, 3.0)
    spp: int = option("samples per pixel of a frame", 16)
    moving: str = option("id of a shape that moves, and not the camera", "")
    widths: float = option("by which it moves in all, of its own", 1.0, 0.15)

    def __post_init__(self):
        super().__post_init__()
        if self.frames < 2:
            raise ValueError(f"--frames must be at least 2, got {self.frames}")


@dataclass
class Film:
    """What an integrator gave.

    runs           frames by run
    seconds        that all runs took, pre-passes and compilation of kernels included
    preparations   pre-passes of a run; of a state that is shared, of all runs
    """

    runs: list[Frames]
    seconds: float
    preparations: int


def run(options: Options, folder: Path, scenes: tuple[Path, ...] = SCENES) -> Iterator[Report]:
    """One report a scene."""
    for path in existing(scenes):
        view = View(path, options.width, merge_meshes=not options.moving)
        scene = view.load()
        if options.moving:
            yield _of_moving_shape(scene, view, options)
        else:
            yield _of_moving_camera(scene, view, options)


def _of_moving_camera(scene: mi.Scene, view: View, options: Options) -> Report:
    shots = [lambda camera=camera: camera for camera in way(scene, view, options)]
    references = _references(scene, shots, view, options, same_seed=False)
    films = {
        PATH.name: _film(scene, shots, view, options, PATH),
        SHARED: _film(scene, shots, view, options, HYBRID),
        ALONE: _film(scene, shots, view, options, HYBRID, alone=True),
    }
    report = _report(view, options, films, references)
    report.findings = [
        f"{_ratio(report, SHARED, PATH.name)} at the same samples, with "
        f"{films[SHARED].preparations} preparation(s) for {options.frames} frames that no "
        "sensor of the scene has announced."
    ]
    return report


def _of_moving_shape(scene: mi.Scene, view: View, options: Options) -> Report:
    shots = moving.shots(scene, options.moving, options.widths, options.frames)
    static = moving.static(scene, shots)
    # The light of all frames changes little: with one seed their differences have little noise.
    references = _references(scene, shots, view, options, same_seed=True)
    films = {}
    for subject in (PATH, HYBRID):
        films[subject.name] = _film(scene, shots, view, options, subject)
        name = f"{subject.name}, {SAME_SEED}"
        films[name] = _film(scene, shots, view, options, subject, same_seed=True)
    report = _report(view, options, films, references, static)
    report.findings = [
        f"{static.mean():.0%} of the pixels see neither {options.moving} nor its shadow.",
        f"{_ratio(report, SHARED, PATH.name)} at the same samples; with one seed for all frames, "
        f"{_ratio(report, f'{SHARED}, {SAME_SEED}', f'{PATH.name}, {SAME_SEED}')}.",
    ]
    return report


# ---------------------- The films ----------------------


def way(scene: mi.Scene, view: View, options: Options) -> list[mi.Sensor]:
    """Sensors of all frames, on an arc round what the scene's own sees in its middle.

    None is the scene's: integrators learn of each as it comes.
    """
    own = scene.sensors()[0]
    values = mi.traverse(own)
    if "x_fov" not in values:
        raise ValueError(f"{view.path}: the first sensor must be perspective")
    to_world = np.array(own.world_transform().matrix).reshape(4, 4)
    width, height = view.size
    ray, _ = own.sample_ray(0.0, 0.5, [0.5, 0.5], [0.5, 0.5])
    hit = scene.ray_intersect(mi.Ray3f(ray.o, ray.d))
    if not hit.is_valid()[0]:
        raise ValueError(f"{view.path}: the first sensor must see a surface in its middle")
    centre, up = np.array(hit.p).ravel(), to_world[:3, 1]
    T = mi.ScalarTransform4f
    turns = np.linspace(-0.5, 0.5, options.frames) * options.degrees
    return [
        mi.load_dict(
            {
                "type": "perspective",
                "fov": float(values["x_fov"][0]),
                "fov_axis": "x",
                "near_clip": values["near_clip"],
                "far_clip": values["far_clip"],
                "to_world": T().translate(centre).rotate(up, turn).translate(-centre) @ T(to_world),
                "film": {
                    "type": "hdrfilm",
                    "width": width,
                    "height": height,
                    "pixel_format": "rgb",
                    "rfilter": {"type": "box"},
                },
            }
        )
        for turn in turns
    ]


def _references(scene, shots, view, options, same_seed: bool) -> tuple[Frames, Frames]:
    """Two of all frames, independent of each other."""
    return tuple(
        _frames(scene, shots, PATH.make, options.reference_spp, seed, "reference", same_seed)[0]
        for seed in (1 << 20, 1 << 21)
    )


def _film(scene, shots, view, options, subject, alone=False, same_seed=False) -> Film:
    """All runs; with one integrator for all of them, or a new one for each frame."""
    hidden = view.hides_emitters()
    one = subject.make(hidden)
    begin, states, runs = time.perf_counter(), 0, []
    for index in range(options.runs):
        seed = options.seed + index * options.frames
        make = (lambda: subject.make(hidden)) if alone else (lambda: one)
        name = ALONE if alone else subject.name
        frames, states = _frames(scene, shots, make, options.spp, seed, name, same_seed)
        runs.append(frames)
    return Film(runs, time.perf_counter() - begin, states)


def _frames(
    scene,
    shots: list[moving.Shot],
    make: Callable[[], mi.Integrator],
    spp: int,
    seed: int,
    name: str,
    same_seed: bool = False,
) -> tuple[Frames, int]:
    """Frames, each with a seed of its own or all with one, and how many caches they took."""
    pictures, caches = [], {}
    with stage(name, total=len(shots)) as advance:
        for index, shot in enumerate(shots):
            camera, integrator = shot(), make()
            its_seed = seed if same_seed else seed + index
            picture = mi.render(scene, sensor=camera, integrator=integrator, spp=spp, seed=its_seed)
            pictures.append(np.array(picture)[:, :, :3])
            if hasattr(integrator, "prepare"):
                cache = integrator.prepare(scene, camera, spp).cache
                caches[id(cache)] = cache  # Held on to, so that no other gets its address.
            advance(1)
    return np.stack(pictures), len(caches)


# ---------------------- Their flicker ----------------------


def flicker(
    frames: Frames, references: tuple[Frames, Frames], static: NDArray | None = None
) -> tuple[NDArray, NDArray]:
    """Squared relative errors of tiles [F], and the squares of their changes [F - 1].

    Only pixels count that are ``static`` [H, W], and tiles of which at least half are.
    The noise of the references, which are independent of each other, counts for nothing: their
    errors are multiplied. Single values may come out negative.
    """
    static = np.ones(frames.shape[1:3], bool) if static is None else static
    share = tiles(static[..., None].astype(np.float64), TILE)[..., 0]
    kept = share >= 0.5
    ours, one, other = (
        np.stack([tiles(p * static[..., None], TILE)[kept] / share[kept, None] for p in f])
        for f in (frames, *references)
    )
    mean = (one.astype(np.float64) + other) / 2
    scale = mean**2 + REL_MSE_EPSILON * mean.mean() ** 2
    first, second = ours - one.astype(np.float64), ours - other.astype(np.float64)
    changes = np.diff(first, axis=0) * np.diff(second, axis=0) / scale[1:]
    return (first * second / scale).mean(axis=(1, 2)), changes.mean(axis=(1, 2))


def _root(values: list[float]) -> Estimate:
    """The root of the mean of squares of independent runs."""
    found = estimate(values)
    root = math.sqrt(max(found.value, 1e-12))
    return Estimate(root, found.margin / (2 * root))


def _ratio(report: Report, ours: str, theirs: str) -> str:
    flicker_of = {name: numbers["flicker"].value for name, numbers in report.numbers.items()}
    ratio = flicker_of[ours] / flicker_of[theirs]
    return f"{SHARED} flickers {ratio:.2f} times as much as path"


def _report(view, options, films: dict[str, Film], references, static=None) -> Report:
    found = {
        name: [flicker(frames, references, static) for frames in film.runs]
        for name, film in films.items()
    }
    errors = {name: _root([e.mean() for e, _ in each]) for name, each in found.items()}
    changes = {name: _root([c.mean() for _, c in each]) for name, each in found.items()}
    width, height = view.size
    title = f"{view.name}, {width}×{height}, {options.frames} frames of {options.spp} samples"
    report = Report(
        name=f"flicker-{view.name}" + (f"-{options.moving}" if options.moving else ""),
        title=title,
        settings={"scene": view, **asdict(options)},
        numbers={
            name: {
                "flicker": changes[name],
                "error": errors[name],
                "preparations": film.preparations,
                "seconds": film.seconds,
                "changes": np.mean([c for _, c in found[name]], axis=0).tolist(),
            }
            for name, film in films.items()
        },
        tables=[
            Table(
                title,
                ["", "flicker [%]", "error [%]", "preparations", "seconds a frame"],
                [
                    [
                        name,
                        _percent(changes[name]),
                        _percent(errors[name]),
                        str(film.preparations),
                        f"{film.seconds / options.runs / options.frames:.2f}",
                    ]
                    for name, film in films.items()
                ],
                f"Root mean squares over tiles of {TILE}×{TILE} pixels, relative to the reference: "
                "of their errors, and of how these change from frame to frame.",
            )
        ],
    )
    report.figures = [_curves(found), _strip(films[SHARED].runs[0])]
    return report


def _percent(value: Estimate) -> str:
    return f"{100 * value.value:.2f} ± {100 * value.margin:.2f}"


def _curves(found) -> Illustration:
    figure, (axes,) = plot()
    for name, each in found.items():
        changes = np.mean([c for _, c in each], axis=0)
        axes.plot(range(1, len(changes) + 1), 100 * np.sqrt(np.maximum(changes, 0)), label=name)
    axes.set(xlabel="frame", ylabel="change of the tiles' errors [%]", ylim=(0, None))
    axes.legend()
    return Illustration("changes", "Change of the tiles' errors from the frame before.", figure)


def _strip(frames: Frames) -> Illustration:
    shown = np.linspace(0, len(frames) - 1, min(COLUMNS, len(frames))).astype(int)
    pictures = {f"frame {index + 1}": frames[index] for index in shown}
    return Illustration("frames", f"Frames of {SHARED}.", panels(pictures, frames[0]))
