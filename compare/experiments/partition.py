"""What the paper's parallel renderer would need: a worker for each cluster, with its map.

The paper (section 4) gives each processor the objects in the cube of a cluster, and its map: then
only primary rays need to be distributed. Rays are counted in one process: which of them such a
worker can answer alone, and how much it would send for the rest. Then real workers load only the
part of one cluster, with and without a coarse occluder for shadow rays, and ask nobody.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
from matplotlib.figure import Figure

from compare.experiments.complexity import ATRIUM_GROUP
from compare.figures import panels
from compare.metrics import Picture, Thirds, error_floor, estimate
from compare.options import JudgedOptions, existing, option
from compare.part_worker import Job, shape_order
from compare.parts import Box, Size, single_triangles, whole_shapes, write_part
from compare.references import reference
from compare.regions import Mask, crop, within
from compare.report import Illustration, Report, Table
from compare.runs import Measurements, Task, interleave
from compare.scenes import HYBRID, ONE_LEVEL_PATH, OWN_SCENES, Subject, View
from compare.walks import ENDS, HELD, Event, Samples, Tally, Work, camera_samples, count_work
from envmap_integrator.lookup.cube_map import Cluster
from envmap_integrator.lookup.lookup import Lookup
from envmap_integrator.preparation.baked_state import BakedState
from envmap_integrator.preparation.scene_state import SceneStates
from envmap_integrator.system.progress import stage

SCENES = (
    OWN_SCENES / "desk.xml",
    OWN_SCENES / "atrium.xml",
    OWN_SCENES / "generated" / "office.xml",
)

LISTED = {
    "atrium": {"group": ATRIUM_GROUP},
    "office": {f"workplace-{n}": (f"*-{n}",) for n in range(8)},
}
"""Ids of the clusters that scenes have by their making."""
NOT_LISTED = "panel-*"
"""Ids that belong to none of these."""

SHADOW_BYTES = 32 + 8
"""Of a shadow ray that is sent (number, origin, direction, length), and of the answer to it."""
PATH_BYTES = 48 + 16
"""Of a ray that is to be followed (number, origin, direction, density, state of the random
numbers), and of the radiance that comes back; of a camera ray too."""
PATCH_BYTES = 4 + 4 + 2 * 3 * 4
"""Of a patch: fingerprint, error, total and indirect irradiance."""
TEXEL_BYTES = 4 * 4
"""Of a texel: radiance and inverse distance."""

WHOLE, EXACT, LEAKY, OCCLUDED = (
    "all of it, asks",
    "all of it, asks nobody",
    "its part, asks nobody",
    "… with an occluder",
)
"""Workers."""


@dataclass(frozen=True)
class Options(JudgedOptions):
    """See ``--help``."""

    width: int = option("of the film, in pixels; its shape is the scene's own", 192, 64)
    runs: int = option("pictures of each kind, with other seeds; at least 3", 3)
    reference_spp: int = option("samples per pixel of each third of the reference", 512, 64)
    spp: int = option("samples per pixel", 64, 8)
    ratio: float = option("half width of a cube over the radius of its cluster", 2.0)
    clusters: str = option("auto, or listed: those that the scene has by its making", "auto")

    def __post_init__(self):
        super().__post_init__()
        if self.clusters not in ("auto", "listed"):
            raise ValueError(f"--clusters must be auto or listed, got {self.clusters}")


@dataclass(frozen=True)
class Owned:
    """A cluster and what its worker needs and does; that without a cluster owns all other hits.

    shapes, triangles   what lies in its cube, by the bounding boxes of shapes and of triangles
    map_bytes           of all levels of its map
    """

    cluster: Cluster | None
    shapes: Size
    triangles: Size
    map_bytes: int
    work: Work

    @property
    def name(self) -> str:
        """For tables."""
        return self.cluster.name if self.cluster else "no cluster"

    @property
    def sent_bytes(self) -> int:
        """What rays that it can't answer alone send to others, and back."""
        return SHADOW_BYTES * self.work.shadow_rays_sent + PATH_BYTES * self.work.paths_sent

    def numbers(self) -> dict[str, object]:
        """For the JSON file."""
        return {
            "name": self.name,
            "half_width": self.cluster.half_width if self.cluster else None,
            "by_shapes": asdict(self.shapes),
            "by_triangles": asdict(self.triangles),
            "map_bytes": self.map_bytes,
            "patches": self.work.patches,
            "patch_bytes": PATCH_BYTES * self.work.patches,
            "rays": {event.name.lower(): n for event, n in self.work.counts.items()},
            "sent_bytes": self.sent_bytes,
        }


@dataclass(frozen=True)
class Prepared:
    """A scene, loaded unmerged, and what ``envmap_hybrid`` looks up in it."""

    view: View
    scene: mi.Scene
    subject: Subject
    baked: BakedState
    fingerprint: str
    lookup: Lookup

    @property
    def clusters(self) -> list[Cluster]:
        """Those that have a map."""
        return [cube_map.cluster for cube_map in self.baked.maps]

    def held(self, index: int) -> Box:
        """Where all that the worker of a cluster holds lies."""
        cluster = self.clusters[index]
        return Box(cluster.centre, HELD * cluster.half_width)


def run(options: Options, folder: Path, scenes: tuple[Path, ...] = SCENES) -> Iterator[Report]:
    """One report a scene."""
    for path in existing(scenes):
        view = View(path, options.width, merge_meshes=False)
        yield _report(prepare(view, options), options, folder)


def prepare(view: View, options: Options) -> Prepared:
    """Load a scene and make its maps; ``ValueError`` if there are no clusters."""
    scene = view.load()
    settings: dict[str, Any] = {"maps": "always", "distance_ratio": options.ratio}
    settings["hide_emitters"] = view.hides_emitters()
    if options.clusters == "listed":
        settings |= _listed(view, scene)
    subject = Subject(HYBRID.integrator, settings, "envmap_hybrid, maps")
    integrator = mi.load_dict({"type": subject.integrator, **settings})
    baked = integrator.prepare(scene, spp=options.spp)
    if not baked.maps:
        raise ValueError(f"{view.path}: there are no clusters; name another scene")
    state = SceneStates()(scene)
    maps = state.maps(scene, baked, options.spp, integrator.mip_bias, True, False)
    return Prepared(view, scene, subject, baked, state.fingerprint, state.lookup(baked, maps))


def _listed(view: View, scene: mi.Scene) -> dict[str, Any]:
    if view.name not in LISTED:
        raise ValueError(f"{view.path}: no clusters are listed for it; leave --clusters out")
    found = {}
    for name, patterns in LISTED[view.name].items():
        ids = [
            shape.id()
            for shape in scene.shapes()
            if any(fnmatch(shape.id(), pattern) for pattern in patterns)
            and not fnmatch(shape.id(), NOT_LISTED)
        ]
        found[name] = {"type": "mipmap_cube", "shapes": ", ".join(ids)}
    return found


# ---------------------- What is counted ----------------------


def owned(prepared: Prepared, options: Options) -> list[Owned]:
    """Each cluster, and last what belongs to none."""
    clusters = prepared.clusters
    tally = Tally(
        np.array([cluster.centre for cluster in clusters]),
        np.array([cluster.half_width for cluster in clusters]),
        prepared.lookup.patches.count,
    )
    integrator = mi.load_dict({"type": prepared.subject.integrator, **prepared.subject.settings})
    rules = integrator.rules(options.seed)
    count_work(prepared.scene, prepared.lookup, rules, tally, options.spp, options.seed)
    shapes, found = prepared.scene.shapes(), []
    for index, (cluster, work) in enumerate(zip(clusters, tally.counts(), strict=False)):
        box = prepared.held(index)
        map_bytes = TEXEL_BYTES * len(prepared.baked.maps[index].texels())
        sizes = whole_shapes(shapes, box), single_triangles(shapes, box)
        found.append(Owned(cluster, *sizes, map_bytes, work))
    everything = whole_shapes(shapes)
    maps = sum(one.map_bytes for one in found)
    return [*found, Owned(None, everything, everything, maps, tally.counts()[-1])]


# ---------------------- Workers that load a part ----------------------


@dataclass(frozen=True)
class Outcome:
    """What a worker has found.

    triangles   that it holds
    measured    seconds and bytes: see ``part_worker``
    pictures    one for each seed, of the pixels of its cluster, [1, pixels, 3]
    """

    triangles: int
    measured: dict[str, float]
    pictures: list[np.ndarray]


def by_workers(
    prepared: Prepared, index: int, samples: Samples, mask: Mask, options: Options
) -> dict[str, Outcome]:
    """The pixels of one cluster, those in a mask, by workers that hold all or a part."""
    outcomes = {}
    with tempfile.TemporaryDirectory() as folder, stage("workers", total=4) as advance:
        asked = write_jobs(prepared, index, samples, mask, options, Path(folder))
        for worker, job in asked.jobs.items():
            outcomes[worker] = _do(job, asked.slot, int(mask.sum()))
            advance(1)
    return outcomes


@dataclass(frozen=True)
class Asked:
    """What workers are to do, by their names, and the number of the pixel of each ray [N]."""

    jobs: dict[str, Job]
    slot: np.ndarray


def write_jobs(
    prepared: Prepared, index: int, samples: Samples, mask: Mask, options: Options, folder: Path
) -> Asked:
    """Write all that the workers of a cluster need for the pixels in a mask to a folder."""
    box, baked = prepared.held(index), prepared.baked
    of_pixel = np.flatnonzero(mask.ravel())
    kept = np.isin(samples.pixel, of_pixel)
    o, d = _from_box(samples.o[kept], samples.d[kept], box)
    np.savez(folder / "rays.npz", o=o, d=d)
    own = replace(
        baked,
        maps=(baked.maps[index],),
        cluster_of_cell=(baked.cluster_of_cell != index).astype(np.uint32),
    )
    baked.save(folder / "all.exr")
    own.save(folder / "own.exr")
    parts = {
        WHOLE: None,
        EXACT: None,
        LEAKY: write_part(prepared.scene, box, folder / "leaky", with_occluder=False),
        OCCLUDED: write_part(prepared.scene, box, folder / "occluded", with_occluder=True),
    }
    order = shape_order(prepared.scene)
    jobs = {
        worker: Job(
            scene=str(prepared.view.path.resolve()),
            settings=prepared.subject.settings,
            variant=mi.variant(),
            folder=str(folder),
            part=None if part is None else asdict(part),
            alone=worker != WHOLE,
            state="all.exr" if worker == WHOLE else "own.exr",
            fingerprint=prepared.fingerprint,
            shape_order=order,
            rays="rays.npz",
            spp=options.spp,
            seeds=tuple(options.seed + i for i in range(options.runs)),
            output=f"worker{number}",
        )
        for number, (worker, part) in enumerate(parts.items())
    }
    return Asked(jobs, np.searchsorted(of_pixel, samples.pixel[kept]))


def _do(job: Job, slot: np.ndarray, n_pixels: int) -> Outcome:
    """Let a process of its own do a job; ``slot`` is the pixel of each ray."""
    folder = Path(job.folder)
    job.save(folder / f"{job.output}-job.json")
    command = [sys.executable, "-m", "compare.part_worker", str(folder / f"{job.output}-job.json")]
    done = subprocess.run(command, capture_output=True, text=True, cwd=Path(__file__).parents[2])
    if done.returncode:
        raise RuntimeError(f"a worker has failed: {done.stderr.strip().splitlines()[-1:]}")
    measured = json.loads((folder / f"{job.output}.json").read_text())
    pictures = []
    for radiance in np.load(folder / f"{job.output}.npy"):
        sums = np.stack([np.bincount(slot, c, n_pixels) for c in radiance.T], axis=1)
        pictures.append((sums / np.bincount(slot, minlength=n_pixels)[:, None])[None])
    return Outcome(int(measured.pop("triangles")), measured, pictures)


def _from_box(o: np.ndarray, d: np.ndarray, box: Box) -> tuple[np.ndarray, np.ndarray]:
    """Rays start where they enter a box, if not in it: what is on their way isn't there for all."""
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = np.stack([(box.centre + s * box.half_width - o) / d for s in (-1, 1)])
    enter = np.nan_to_num(ends.min(axis=0), nan=-np.inf).max(axis=1)
    # Rather too early than too late.
    enter = np.maximum(enter * (1 - 1e-5), 0)
    return (o + enter[:, None] * d).astype(np.float32), d.astype(np.float32)


# ---------------------- The report ----------------------


def _report(prepared: Prepared, options: Options, folder: Path) -> Report:
    view, scene = prepared.view, prepared.scene
    owners = owned(prepared, options)
    samples = camera_samples(scene, prepared.lookup, options.spp, options.seed, len(owners) - 1)
    masks = [samples.all_of(index) for index in range(len(owners))]
    truth = reference(view, options.reference_spp, folder / "references")
    tasks = [Task(scene, subject, options.spp) for subject in (prepared.subject, ONE_LEVEL_PATH)]
    pictures = interleave(tasks, options.runs, options.seed, view.hides_emitters())
    index = int(np.argmax([mask.sum() for mask in masks[:-1]]))
    if not masks[index].any():
        raise ValueError(f"{view.path}: no cluster fills a pixel; raise --width")
    workers = by_workers(prepared, index, samples, masks[index], options)

    errors = _errors(owners, masks, pictures, truth.thirds)
    judged = _judged(workers, masks[index], truth.thirds)
    suffix = "-listed" if options.clusters == "listed" else ""
    return Report(
        name=f"partition-{view.name}{suffix}",
        title=f"{view.name}: a worker for each cluster",
        settings=asdict(options) | {"scene": view.name, "integrator": prepared.subject},
        findings=[_finding(owners)],
        tables=[
            _needs(owners),
            _rays(owners),
            _error_table(errors),
            _worker_table(owners[index].name, judged),
        ],
        figures=[
            Illustration(
                "workers",
                f"The pixels of {owners[index].name}, by path and by workers, and their errors.",
                _pictures(workers, masks[index], truth.picture),
            )
        ],
        numbers={
            "owners": [owner.numbers() for owner in owners],
            "shadow_bytes": SHADOW_BYTES,
            "path_bytes": PATH_BYTES,
            "errors": errors,
            "worker_of": owners[index].name,
            "workers": judged,
            "reference": truth.numbers(),
            "pictures": [one.numbers() for one in pictures],
        },
    )


def _pictures(workers: dict[str, Outcome], mask: Mask, truth: Picture) -> Figure:
    """The part of the picture that shows the workers' pixels; all else as by path."""
    found = {}
    for name, outcome in workers.items():
        picture = truth.copy()
        picture[mask] = np.mean(outcome.pictures, axis=0)[0]
        found[name] = crop(picture, mask)
    seen = crop(truth, mask)
    return panels({"path": seen} | found, seen, found, columns=len(found) + 1)


def _errors(
    owners: list[Owned], masks: list[Mask], measured: list[Measurements], thirds: Thirds
) -> dict[str, dict[str, dict[str, float]]]:
    """Errors without noise of each integrator, in the pixels of each owner that fill them."""
    regions = {o.name: mask for o, mask in zip(owners, masks, strict=True) if mask.any()}
    regions["whole picture"] = np.ones_like(masks[0])
    return {
        name: {
            one.subject.name: _judge([within(p, mask) for p in one.pictures()], mask, thirds)
            for one in measured
        }
        for name, mask in regions.items()
    }


def _judge(pictures: list[np.ndarray], mask: Mask, thirds: Thirds) -> dict[str, float]:
    """Error that is left without noise, and of the mean with its interval, in a region."""
    truth = tuple(within(third, mask) for third in thirds)
    mean = np.mean([third.mean(dtype=np.float64) for third in truth])
    bias = estimate([p.mean(dtype=np.float64) / mean - 1 for p in pictures])
    own = estimate([t.mean(dtype=np.float64) / mean - 1 for t in truth])
    return {
        "floor": error_floor(pictures, truth),
        "bias": bias.value,
        "margin": float(np.hypot(bias.margin, own.margin)),
    }


def _judged(workers: dict[str, Outcome], mask: Mask, thirds: Thirds) -> dict[str, dict[str, float]]:
    """What each worker held, how long it took, and its errors."""
    whole = workers[WHOLE].pictures
    found = {}
    for name, outcome in workers.items():
        # The same random numbers: what differs is the worker.
        pairs = list(zip(outcome.pictures, whole, strict=True))
        scale = np.mean([w.mean() for w in whole])
        found[name] = (
            {"triangles": outcome.triangles}
            | outcome.measured
            | _judge(outcome.pictures, mask, thirds)
            | {"mean_over_whole": float(np.mean([(p - w).mean() for p, w in pairs]) / scale)}
        )
    return found


def _finding(owners: list[Owned]) -> str:
    clusters = owners[:-1]

    def total(event: Event) -> int:
        return sum(owner.work.counts[event] for owner in clusters)

    hits, secondary = total(Event.CAMERA), max(total(Event.SECONDARY), 1)
    everywhere = hits + owners[-1].work.counts[Event.CAMERA]
    sent = sum(owner.work.paths_sent for owner in clusters)
    shadows = sum(owner.work.shadow_rays_sent for owner in clusters)
    n_bytes = sum(owner.sent_bytes for owner in clusters)
    by_maps = PATH_BYTES * total(Event.MAP)
    scene = owners[-1].shapes.bytes + owners[-1].shapes.textures
    return (
        f"Clusters own {hits / everywhere:.0%} of the camera hits. Of these, workers serve "
        f"{1 - sent / secondary:.1%} of the secondary rays alone (without their maps "
        f"{total(Event.INSIDE) / secondary:.1%}) and "
        f"{1 - shadows / max(total(Event.SHADOW), 1):.1%} of the shadow rays. The rest sends "
        f"{n_bytes / max(hits, 1):.0f} bytes a camera hit (without maps "
        f"{(n_bytes + by_maps) / max(hits, 1):.0f}), beside the {PATH_BYTES} of the hit itself: in "
        f"all {(n_bytes + PATH_BYTES * hits) / 1e6:.0f} MB for this picture, of a scene of "
        f"{scene / 1e6:.1f} MB."
    )


def _needs(owners: list[Owned]) -> Table:
    whole = owners[-1]
    rows = [
        [
            owner.name,
            f"{owner.cluster.half_width:.2f}" if owner.cluster else "",
            f"{owner.triangles.triangles:,} ({_part(owner, whole, 'triangles', 'triangles')})",
            _part(owner, whole, "shapes", "triangles"),
            f"{owner.triangles.bytes / 1e6:.1f} ({_part(owner, whole, 'triangles', 'bytes')})",
            f"{owner.triangles.textures / 1e6:.1f}",
            f"{owner.map_bytes / 1e6:.1f}",
            f"{PATCH_BYTES * owner.work.patches / 1e3:.0f}",
        ]
        for owner in owners
    ]
    columns = [
        "", "half width", "triangles", "… by shapes", "geometry [MB]", "textures [MB]", "map [MB]",
        "patches read [kB]",
    ]  # fmt: skip
    return Table("What a worker needs", columns, rows, "In its cube and a fifth around it.")


def _part(owner: Owned, whole: Owned, by: str, what: str) -> str:
    """Of the whole scene."""
    value, everything = (getattr(getattr(o, by), what) for o in (owner, whole))
    return f"{value / max(everything, 1):.0%}"


def _rays(owners: list[Owned]) -> Table:
    n_hits = sum(owner.work.counts[Event.CAMERA] for owner in owners)
    rows = []
    for owner in owners:
        work, hits = owner.work, owner.work.counts[Event.CAMERA]
        shares = [
            work.share(Event.INSIDE, Event.MAP, of=Event.SECONDARY),
            *(work.share(event, of=Event.SECONDARY) for event in ENDS),
            work.share(Event.WITHIN, Event.BLOCKED, of=Event.SHADOW),
        ]
        rows.append(
            [
                owner.name,
                f"{hits / max(n_hits, 1):.1%}",
                *(f"{share:.1%}" if hits else "–" for share in shares),
                f"{owner.sent_bytes / hits:.0f}" if hits else "–",
            ]
        )
    columns = [
        "", "camera hits", "secondary: alone", "… inside", "… map", "map uncertain", "narrow",
        "others", "shadow: alone", "bytes sent a hit",
    ]  # fmt: skip
    placed = owners[-1].work.share(Event.PLACED, of=Event.CAMERA)
    note = f"Of the hits of no cluster, {placed:.0%} lie in what some worker holds."
    return Table("What it can answer alone", columns, rows, note)


def _error_table(errors: dict[str, dict[str, dict[str, float]]]) -> Table:
    names = list(next(iter(errors.values())))
    rows = [
        [region, *(text for name in names for text in _errors_as_text(found[name]))]
        for region, found in errors.items()
    ]
    columns = ["pixels of", *(f"{name}: {what}" for name in names for what in ("floor", "bias"))]
    return Table("Errors against path, without noise", columns, rows)


def _errors_as_text(found: dict[str, float]) -> tuple[str, str]:
    return f"{found['floor']:.1e}", f"{found['bias']:+.2%} ± {found['margin']:.2%}"


def _worker_table(name: str, judged: dict[str, dict[str, float]]) -> Table:
    rows = [
        [
            worker,
            f"{one['triangles']:,}",
            f"{one['loaded_bytes'] / 1e6:.0f}",
            f"{one['peak_bytes'] / 1e6:.0f}",
            f"{one['load_s']:.1f}",
            f"{one['render_s']:.1f}",
            *_errors_as_text(one),
            f"{one['mean_over_whole']:+.2%}",
        ]
        for worker, one in judged.items()
    ]
    columns = [
        "holds", "triangles", "loaded [MB]", "peak [MB]", "load [s]", "render [s]", "floor", "bias",
        "mean, to the first",
    ]  # fmt: skip
    empty = next(iter(judged.values()))["empty_bytes"] / 1e6
    return Table(
        f"Workers of {name}", columns, rows, f"Memory above the {empty:.0f} MB of any process."
    )
