"""A process that holds a part of a scene, or all of it, and finds the light along camera rays.

``python -m compare.part_worker JOB.json`` does a ``Job`` and writes what it has found.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from compare.metrics import Picture
from compare.parts import Part, PartFile, whole_shapes
from compare.scenes import HYBRID
from envmap_integrator.cli.commands import activate_variant
from envmap_integrator.lookup.emitter_choice import EmitterChoice, Emitters
from envmap_integrator.lookup.far_field import Cube, FarField, far_field
from envmap_integrator.lookup.ids import ObjectIds
from envmap_integrator.lookup.lookup import Lookup
from envmap_integrator.preparation.baked_state import BakedState, StateKey, load
from envmap_integrator.system.jit import upload, upload_vectors
from envmap_integrator.system.scene_order import ordered_shapes
from envmap_integrator.transport.camera import camera_radiance


class Alone(FarField):
    """The map of a worker that asks nobody.

    All surfaces in the cube read it, mirrors and those of other clusters too, and it is trusted
    everywhere.
    """

    def cube(self, cell: mi.UInt32, p: mi.Point3f, active: mi.Bool) -> Cube:
        """The worker's cube for all points in it."""
        cube = dr.gather(mi.Vector4f, self.cubes, mi.UInt32(0))
        centre, half_width = mi.Point3f(cube.x, cube.y, cube.z), cube.w
        inside = dr.all(dr.abs(p - centre) < half_width)
        return Cube(dr.zeros(mi.UInt32), centre, half_width, inside)

    def eval(self, *arguments: Any) -> tuple[mi.Spectrum, mi.Bool]:
        """What the map holds, or what stands there for what it doesn't."""
        return super().eval(*arguments)[0], mi.Bool(True)


@dataclass(frozen=True)
class Job:
    """Plain values, for JSON.

    scene               the scene file
    settings            of ``envmap_hybrid``
    variant             of Mitsuba
    folder              of all other files
    part                what to load of it, None for all
    alone               whether to ask nobody: see ``Alone``
    state               name of the file of the baked state; of its own map only, if alone
    fingerprint         of the whole scene
    shape_order         number in the file of each shape, in the order that the state counts them
    rays                name of an .npz file: ``o`` and ``d`` [N, 3]
    spp                 samples that share a pixel
    seeds               of the random numbers, each of a picture of its own
    output              name of the .npy file of the radiance found [seeds, N, 3], and of a .json
                        file
    """

    scene: str
    settings: Mapping[str, Any]
    variant: str
    folder: str
    part: dict[str, Any] | None
    alone: bool
    state: str
    fingerprint: str
    shape_order: list[int]
    rays: str
    spp: int
    seeds: tuple[int, ...]
    output: str

    def save(self, path: Path) -> None:
        """Write it to a file."""
        path.write_text(json.dumps(asdict(self)))

    @classmethod
    def read(cls, path: Path) -> Job:
        """Inverse of ``save``."""
        values = json.loads(path.read_text())
        if values["part"] is not None:  # JSON makes texts of numbers that are keys.
            clipped = values["part"]["clipped"]
            values["part"]["clipped"] = {int(number): name for number, name in clipped.items()}
        return cls(**{item.name: values[item.name] for item in fields(cls)})


def do(job: Job) -> tuple[np.ndarray, dict[str, float]]:
    """The radiance that comes along the rays [seeds, N, 3], and seconds and bytes.

    The last of the seeds' times is without compilation, if there are several.
    """
    folder = Path(job.folder)
    dr.eval(dr.arange(mi.Float, 1) + 1)  # Starts all that every process has.
    empty = resident("VmRSS")
    begin = time.perf_counter()
    scene, numbers = _scene(job)
    load_s, loaded = time.perf_counter() - begin, resident("VmRSS")

    lookup = _lookup(job, scene, numbers)
    rays = np.load(folder / job.rays)
    found, seconds = [], []
    for seed in job.seeds:
        begin = time.perf_counter()
        found.append(along(scene, lookup, rays["o"], rays["d"], seed))
        seconds.append(time.perf_counter() - begin)
    return np.stack(found), {
        "triangles": whole_shapes(scene.shapes()).triangles,
        "load_s": load_s,
        "render_s": seconds[-1],
        "empty_bytes": empty,
        "loaded_bytes": loaded - empty,
        "peak_bytes": resident("VmHWM") - empty,
    }


def along(scene: mi.Scene, lookup: Lookup, o: np.ndarray, d: np.ndarray, seed: int) -> Picture:
    """The radiance that comes along rays from ``o`` in directions ``d`` [N, 3]."""
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed, len(o))
    ray = mi.Ray3f(upload_vectors(mi.Point3f, o), upload_vectors(mi.Vector3f, d))
    rules = HYBRID.make().rules(seed)
    found = camera_radiance(scene, lookup, rules, sampler, ray, mi.Bool(True))
    return np.array(found.radiance).reshape(len(mi.Spectrum()), -1).T


def _scene(job: Job) -> tuple[mi.Scene, list[int]]:
    """What the worker holds, and the number in the file of each shape; -1 for the occluder."""
    scene_file = PartFile(Path(job.scene))
    if job.part is None:
        scene = scene_file.load(merge_meshes=False)
        return scene, list(range(len(scene.shapes())))
    part = Part(**job.part)
    scene_file.keep(part)
    scene = scene_file.load(merge_meshes=False)
    occluder = [-1] if part.occluder else []
    return scene, part.kept + occluder


def _lookup(job: Job, scene: mi.Scene, numbers: list[int]) -> Lookup:
    """What paths look up: objects have the ids that they have in the whole scene."""
    emitters = Emitters.of(scene)
    integrator = mi.load_dict({"type": HYBRID.integrator, **job.settings})
    key = StateKey(job.fingerprint, integrator.settings())
    baked = load(str(Path(job.folder) / job.state), key, job.output, emitters.count)
    choice = EmitterChoice(emitters, baked.emitter_table, baked.emitter_rows)
    ids = whole_ids(scene, numbers, job.shape_order)
    maps = maps_of(scene, baked, job.spp, integrator.mip_bias, job.alone)
    return Lookup(baked.cache.patches, ids, choice, baked.cache, maps)


def maps_of(
    scene: mi.Scene, baked: BakedState, spp: int, mip_bias: float, alone: bool
) -> FarField | None:
    """The maps of a state, for a worker that asks nobody or for one that can."""
    maps = far_field(
        scene, baked.maps, baked.cluster_of_cell, spp, mip_bias, corrected=True, map_mirrors=alone
    )
    return Alone(**vars(maps)) if alone else maps


def whole_ids(scene: mi.Scene, numbers: list[int], order: list[int]) -> ObjectIds:
    """The ids that shapes have in the whole scene, of shapes with these ``numbers`` in its file.

    ``order`` is that of all shapes there, by the same numbers.
    """
    id_of = {number: index for index, number in enumerate(order)}
    registry_ids = dr.reinterpret_array(mi.UInt32, mi.ShapePtr(scene.shapes())).numpy()
    table = np.full(int(registry_ids.max()) + 1, len(order), dtype=np.uint32)
    table[registry_ids] = [id_of.get(number, len(order)) for number in numbers]
    return ObjectIds(len(order), upload(mi.UInt32, table))


def shape_order(scene: mi.Scene) -> list[int]:
    """Number in the file of each shape of a scene that is loaded unmerged, as ids count them."""
    number = {shape.ptr: index for index, shape in enumerate(scene.shapes())}
    return [number[shape.ptr] for shape in ordered_shapes(scene)]


def resident(field: str) -> int:
    """Bytes of memory of this process: ``VmRSS`` now, ``VmHWM`` at most so far (Linux)."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) * 1024 for line in lines if line.startswith(field))


def main(path: str) -> None:
    """Do the job of a file."""
    job = Job.read(Path(path))
    activate_variant(job.variant)
    radiance, measured = do(job)
    np.save(Path(job.folder) / f"{job.output}.npy", radiance)
    (Path(job.folder) / f"{job.output}.json").write_text(json.dumps(measured))


if __name__ == "__main__":
    main(sys.argv[1])
