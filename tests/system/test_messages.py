"""Every error of the package says in one line what is wrong, with which value, and how to mend it.

Each place in the package that raises an error has a case here; the source is searched for them.
"""

from __future__ import annotations

import argparse
import ast
import asyncio
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from distributed import KilledWorker

import envmap_integrator
from compare.hard_cases import empty_mesh
from envmap_integrator.cli import commands
from envmap_integrator.cli.arguments import parse_assignment
from envmap_integrator.distributed import tasks
from envmap_integrator.distributed.cluster import connected as cluster_at
from envmap_integrator.distributed.job import View
from envmap_integrator.distributed.render import check_workers, render_job
from envmap_integrator.distributed.tasks import workers_of
from envmap_integrator.distributed.worker import Outcome
from envmap_integrator.imaging import film
from envmap_integrator.imaging.aovs import parse_aovs
from envmap_integrator.imaging.denoiser import warm_up
from envmap_integrator.inspection.page import inspect
from envmap_integrator.preparation.maps.clusters import ClusterRequest, listed_clusters
from envmap_integrator.system import memory, storage
from envmap_integrator.system.atomic import check_writable, replacing
from envmap_integrator.system.checks import check_not_frozen, check_scene, check_variant
from envmap_integrator.system.llvm import ensure_llvm
from envmap_integrator.system.parameters import Parameters
from envmap_integrator.system.scene_file import SceneFile
from tests.helpers import (
    at,
    ball,
    box,
    camera,
    cluster,
    grey,
    integrator,
    load,
    room,
    scaled,
    unprivileged,
)
from tests.unit.kit import surface_points

pytestmark = pytest.mark.usefixtures("variant")

PACKAGE = Path(envmap_integrator.__file__).parent
#: What isn't a message for users: an abstract method, errors raised on, and those that are caught.
EXCEPTED = {
    "raise NotImplementedError",
    "raise",
    """raise ValueError("sizes that can't be true")""",
    "raise MemoryError",
    "raise error",
    "raise cause from None",
    "raise KeyboardInterrupt from error",
}
MEDIUM = {"type": "homogeneous", "albedo": 0.5, "sigma_t": 1.0}
#: Of small pieces, so that a change of a file's content is quick.
FORMAT = f'{{"format": {storage.FORMAT}'.encode()
SETTINGS = {"patches": 64, "map_resolution": 4, "desk": cluster()}

Site = tuple[str, int]


@dataclass(frozen=True)
class Case:
    """An action that ends in an error, and what its message has to name."""

    action: Callable[[Surroundings], object]
    object: str
    value: str
    mend: str


@dataclass(frozen=True)
class Surroundings:
    """What actions need: a folder, one that others can come to, a saved state, and patches."""

    folder: Path
    public: Path
    state: Path
    patch: pytest.MonkeyPatch


# ---------------------- The cases ----------------------


def parameter(method: str, value: object, *arguments: object) -> Callable:
    def action(_):
        props = mi.Properties("plugin")
        props.set_id("ours")
        props["x"] = value
        getattr(Parameters(props), method)("x", *arguments)

    return action


def scene(**changes: object) -> Callable:
    return lambda _: check_scene(load(room(**changes)), "ours")


def faceless(_: Surroundings) -> None:
    check_scene(load(empty_mesh()), "ours")


def emitter(**parameters: object) -> Callable:
    return lambda s: mi.load_dict(
        {"type": "mipmap_cube", "id": "sky"}
        | {key: str(v(s)) if key == "filename" else v for key, v in parameters.items()}
    )


def aovs(text: str) -> Callable:
    return lambda _: parse_aovs(text, "ours")


def frozen(_: Surroundings) -> None:
    with dr.scoped_set_flag(dr.JitFlag.FreezingScope, True):
        check_not_frozen("envmap_hybrid")


def differentiated(_: Surroundings) -> None:
    integrator("envmap_hybrid").render_backward(load(room()), None, None)


def listed(*shapes: str) -> Callable:
    request = ClusterRequest("desk", shapes, None)
    points = surface_points(np.zeros((1, 3)), [0, 0, 1], object_id=0)
    return lambda _: listed_clusters(points, np.zeros(1), load(room()), (request,), 2.0)


def plain_picture(shape: tuple[int, int]) -> Callable[[Surroundings], Path]:
    """A picture of another tool."""

    def make(s):
        channels = {name: np.ones(shape, np.float32) for name in "RGB"}
        storage.write_pictures(s.folder / "plain.exr", {"a": channels}, {})
        return s.folder / "plain.exr"

    return make


def use(make: Callable[[Surroundings], Path]) -> Callable:
    """Prepare from the file that ``make`` leaves."""
    return lambda s: integrator("envmap_hybrid", cache_file=str(make(s)), **SETTINGS).prepare(
        load(room())
    )


def rebake(name: str, make: Callable[[Surroundings], Path]) -> Callable:
    """Bake one map anew in the file that ``make`` leaves."""
    return lambda s: integrator("envmap_hybrid", **SETTINGS).rebake(load(room()), make(s), [name])


def brighter(parts: dict, metadata: dict) -> None:
    parts["irradiance"]["Y"] = 2 * parts["irradiance"]["Y"]


def seen_from_elsewhere(s: Surroundings) -> None:
    """From beneath the floor, where no sensor of the scene has been."""
    below = mi.load_dict(camera(origin=(0, -1.8, -5), target=(0, 0.5, -9)))
    shell = box(3) | {"to_world": at(0, 0, -6) @ scaled(3)} | grey(0.5)
    described = room(cellar=shell)
    path = s.folder / "state.exr"
    integrator("envmap_hybrid", **SETTINGS).prepare(load(described)).save(path)
    integrator("envmap_hybrid", cache_file=str(path), **SETTINGS).prepare(load(described), below)


def nested_without_sensor(s: Surroundings) -> None:
    child = {"type": "envmap_hybrid"} | SETTINGS
    within = mi.load_dict({"type": "aov", "aovs": "d:depth", "child": child})
    sensor = mi.load_dict(camera())
    mi.render(load(room(sensor=None)), sensor=sensor, integrator=within, spp=1)


def rendered(*size: int, **more: object) -> Callable:
    """A picture by such a ``camera``."""
    ours = "one_level_path"
    return lambda _: integrator(ours).render(load(room(sensor=camera(*size, **more))))


def altered(change: Callable[[dict, dict], object]) -> Callable[[Surroundings], Path]:
    """A state of which ``change(parts, metadata)`` has altered something."""

    def make(s):
        stored = storage.read(s.state, "")
        change(stored.parts, stored.metadata)
        storage.write(s.folder / "altered.exr", stored.parts, stored.metadata)
        return s.folder / "altered.exr"

    return make


def with_bytes(change: Callable[[bytes], bytes]) -> Callable[[Surroundings], Path]:
    def make(s):
        path = s.folder / "altered.exr"
        path.write_bytes(change(s.state.read_bytes()))
        return path

    return make


def forged(content: bytes) -> bytes:
    """Metadata that aren't JSON, with the right digest."""
    kept = content.replace(b'"scene":', b'"scene";')[: -storage._DIGEST_SIZE]
    return kept + storage._digest(kept)


def too_many_samples(s: Surroundings) -> None:
    s.patch.setattr(film, "MAX_LANES", 32 * 24 * 8)
    ours = integrator("one_level_path", sampler="independent", patches=64)
    ours.render(load(room()), spp=9)


def progressive(sampler: str = "coherent", **asked: object) -> Callable:
    ours = "one_level_path"
    return lambda _: integrator(ours, sampler=sampler).progressive(load(room()), **asked)


def resumed(change: Callable[[dict, dict], object], seed: int = 0) -> Callable:
    """Go on from a progress file of which ``change`` has altered something."""

    def action(s):
        path = s.folder / "room.progress.exr"
        ours, described = integrator("one_level_path", patches=64, sampler="coherent"), load(room())
        list(ours.progressive(described, spp=1, total=1, progress_file=path))
        stored = storage.read(path, "")
        change(stored.parts, stored.metadata)
        storage.write(path, stored.parts, stored.metadata)
        ours.progressive(described, seed=seed, progress_file=path, resume=True, spp=1)

    return action


def half_sum(parts: dict, metadata: dict) -> None:
    parts["stream0"] = {name: image[:12].copy() for name, image in parts["stream0"].items()}


def hide(s: Surroundings) -> Path:
    path = s.public / "state.exr"
    path.write_bytes(s.state.read_bytes())
    path.chmod(0)
    return path


def read_hidden(s: Surroundings) -> None:
    path = hide(s)
    with unprivileged():
        storage.read(path, "make it again")


def write_protected(s: Surroundings) -> None:
    s.public.chmod(0o555)
    with unprivileged():
        check_writable(s.public / "state.exr")


def fill_the_disk(s: Surroundings) -> None:
    with replacing(s.folder / "state.exr"):
        raise OSError(28, "No space left on device")


def command_line(**options: object) -> argparse.Namespace:
    defaults = {"mode": "llvm_ad_rgb", "threads": None, "define": [], "set": [], "debug": False}
    defaults |= {"integrator": None, "sensor": 0, "spp": 1, "seed": 0, "png": False}
    defaults |= {"progressive": False, "time": None, "target_error": None, "resume": False}
    defaults |= {"clusters": None}
    defaults |= {"quiet": True, "json": False, "workers": None, "cluster": None, "tls": None}
    return argparse.Namespace(**defaults | {"denoise": False} | options)


def shell(command: Callable, **options: object) -> Callable:
    """A command, of a scene of a ball under a grey sky."""

    def action(s):
        path = s.folder / "ball.xml"
        path.write_text(
            '<scene version="3.0.0"> <sensor type="perspective"> <film type="hdrfilm">'
            '<string name="pixel_format" value="luminance"/> <integer name="width" value="4"/>'
            '<integer name="height" value="4"/> </film> </sensor> <integrator type="path"/>'
            '<shape type="sphere"/> <emitter type="constant"/> </scene>'
        )
        output = s.folder / options.get("output", "ball.exr")
        command(command_line(scene=path, **options | {"output": output}))

    return action


def xml(text: str) -> Callable:
    def action(s):
        path = s.folder / "scene.xml"
        path.write_text(text)
        SceneFile(path)

    return action


def without_jinja(s: Surroundings) -> None:
    s.patch.setitem(sys.modules, "jinja2", None)
    inspect("a.html", load(room()), integrator("envmap_hybrid"))


def without_denoiser(s: Surroundings) -> None:
    s.patch.setitem(sys.modules, "mitsuba_oidn", None)
    warm_up(4, 4)


def old_llvm(s: Surroundings) -> None:
    s.patch.setattr(dr.detail, "llvm_version", lambda: (15, 0, 6))
    ensure_llvm()


def little_memory(action: Callable, free: float = 1e9) -> Callable:
    def run(s):
        for module in (memory, storage):
            s.patch.setattr(module, "free_memory", lambda: free)
        action(s)

    return run


def other_variant(s: Surroundings) -> None:
    s.patch.setattr(mi, "variant", lambda: "scalar_rgb")
    check_variant("envmap_hybrid")


def grey_map(parts: dict, metadata: dict) -> None:
    """Maps of one colour channel instead of three."""
    for name in [name for name in parts if name.startswith("map")]:
        parts[name] = {"Y": parts[name]["R"], "inverse_distance": parts[name]["inverse_distance"]}


def half_map(parts: dict, metadata: dict) -> None:
    parts["map0/level0"] = {c: image[:2].copy() for c, image in parts["map0/level0"].items()}


def wrong_rows(parts: dict, metadata: dict) -> None:
    parts["emitter_rows"]["row"][:] = 10**6


def no_maps(parts: dict, metadata: dict) -> None:
    metadata["maps"] = []


def setting(name: str, value: object, entry: str | None = None) -> Callable:
    def change(parts, metadata):
        (metadata[entry][0] if entry else metadata)[name] = value

    return change


class Ended:
    """What Dask gives of a call that has ended."""

    key, status = "call", "error"

    def __init__(self, error: Exception | None = None, outcome: Outcome | None = None):
        self.error, self.outcome = error, outcome

    def exception(self):
        return self.error

    def result(self, timeout: float):
        if self.error:
            raise self.error
        return self.outcome


def crew(workers: dict | None = None, **client: object) -> tasks._Crew:
    """One that has sent a single call to a cluster that isn't there."""

    async def identity(n_workers: int):
        return {"workers": workers or {}}

    def sync(function: Callable, *arguments: object, callback_timeout: float | None = None):
        return asyncio.run(function(*arguments))

    scheduler = SimpleNamespace(address="tcp://here:1", identity=identity)
    here = {"status": "running", "scheduler": scheduler, "sync": sync}
    sent = tasks._Crew(SimpleNamespace(**here | client), None, [()], 9.0, None)
    sent.pending[0] = Ended()
    return sent


def answered(status: str = "finished", **ended: object) -> Callable:
    def action(_):
        future = Ended(**ended)
        future.status = status
        sent = crew()
        sent.pending[0], sent.tries[0] = future, tasks.MOST_TRIES
        sent._outcome(0, future)

    return action


def died() -> KilledWorker:
    return KilledWorker("call", SimpleNamespace(address="tcp://there:2"), 3)


def looked_after(workers: dict | None = None, **client: object) -> Callable:
    def action(_):
        sent = crew(workers, **client)
        sent.last_look = sent.last_worker = -100.0
        sent.look_after_workers()

    return action


def hung(_: Surroundings) -> None:
    sent = crew(workers={"tcp://there:2": {}})
    sent.tries[0] = tasks.MOST_TRIES
    sent._give_up("tcp://there:2", [0], 9.0)


def nobody_comes(_: Surroundings) -> None:
    def wait(n: int, timeout: float):
        raise TimeoutError

    check_workers(crew(wait_for_workers=wait).client, None)


def scheduler_at(address: str, tls: tuple | None = None) -> Callable:
    return lambda _: cluster_at(address, tls).__enter__()


def scheduler_that_fails(reason: str) -> Callable:
    def client(*_, **__):
        raise OSError(reason)

    def action(s):
        s.patch.setattr("envmap_integrator.distributed.cluster.Client", client)
        cluster_at("tcp://there:1").__enter__()

    return action


def another_version(_: Surroundings) -> None:
    async def run(*_, workers: list[str], on_error: str):
        fault = "has mitsuba 3.8.0 instead of 3.9.1; install that version there"
        return dict.fromkeys(workers, fault)

    there = {"tcp://there:2": {}}
    check_workers(crew(there, wait_for_workers=lambda *_, timeout: None, run=run).client, None)


def silent_scheduler(_: Surroundings) -> None:
    def sync(function: Callable, callback_timeout: float):
        raise TimeoutError

    workers_of(crew(sync=sync).client)


def in_parts(kind: str, **settings: object) -> Callable:
    scene = SimpleNamespace(integrator=lambda: mi.load_dict({"type": kind, **settings}))
    return lambda _: next(render_job(None, None, scene, []))


def no_such_sensor(_: Surroundings) -> None:
    with View(3).of(load(room())):
        pass


def without_dask(s: Surroundings) -> None:
    s.patch.setattr("importlib.util.find_spec", lambda name: None)
    shell(commands.render, workers=2)(s)


def on_bands(shortest: float, longest: float, **settings: object) -> Callable:
    """Rendering with a band between two wavelengths [nm]."""

    def action(_):
        mi.set_variant("llvm_ad_spectral")
        band = {"type": "spectrum", "value": [(shortest, 1.0), (longest, 1.0)]}
        sensor = camera() | {"film": {"type": "specfilm", "width": 4, "height": 4, "band": band}}
        picture = integrator("one_level_path", **settings)
        picture.render(load(room(sensor=sensor)), spp=1)

    return action


def png_of_bands(s: Surroundings) -> None:
    mi.set_variant("llvm_ad_spectral")
    path = s.folder / "bands.xml"
    path.write_text(
        '<scene version="3.0.0"> <sensor type="perspective"> <film type="specfilm">'
        '<spectrum name="band" value="500:1, 600:1"/> </film> </sensor>'
        '<shape type="sphere"/> <emitter type="constant"/> </scene>'
    )
    options = {"scene": path, "output": s.folder / "bands.exr", "mode": "llvm_ad_spectral"}
    commands.render(command_line(**options, png=True))


AGAIN = "make it again with envmap-render bake"
STATE = '"cache_file" {folder}/altered.exr'
CASES = {
    # ---- Parameters ----
    "integer": Case(parameter("integer", 2.5, 1, 1), '"ours": "x"', "2.5", "must be an integer"),
    "power": Case(parameter("power_of_two", 3, 1, 1, 8), '"x"', "3", "must be a power of two"),
    "number": Case(parameter("number", "a", 1.0, 0.0), '"x"', "'a'", "must be a number"),
    "flag": Case(parameter("flag", 3, True), '"x"', "3", "must be true or false"),
    "choice": Case(parameter("choice", "c", "a", ("a", "b")), '"x"', "'c'", '"a" or "b"'),
    "text": Case(parameter("text", 3), '"x"', "3", "must be a string"),
    "range": Case(parameter("integer", 9, 1, 1, 8), '"x"', "9", "at least 1 and at most 8"),
    "misspelt": Case(
        lambda _: integrator("envmap_hybrid", map_resolutoin=8),
        "envmap_hybrid", '"map_resolutoin"', 'write "map_resolution" or remove it',
    ),
    "AOV": Case(aovs("p:patch, depth"), "ours", '"depth"', "must list name:type"),
    "AOV twice": Case(aovs("a:patch, a:served"), "ours", 'two of the name "a"', "rename one"),
    "nested": Case(
        lambda _: integrator("envmap_hybrid", cube={"type": "point"}),
        "envmap_hybrid", 'PointLight "cube"', "must be one envmap_bake or a mipmap_cube",
    ),
    "nested without maps": Case(
        lambda _: integrator("one_level_path", desk=cluster("ball")),
        "one_level_path", 'the nested Emitter "desk"', "use envmap_hybrid",
    ),
    "to_world": Case(
        lambda _: emitter(shapes="a", to_world=mi.ScalarTransform4f())(_),
        'mipmap_cube "sky"', '"to_world"', "remove it",
    ),
    "rotation": Case(
        lambda s: parameter("rotation", mi.ScalarTransform4f().scale([1, 2, 1]))(s),
        '"ours": "x"', "1 0 0 0 2 0 0 0 1", "must rotate, without stretching",
    ),
    "point": Case(parameter("point", "1, 2"), '"ours": "x"', "'1, 2'", "must be three numbers"),
    "neither": Case(emitter(), 'mipmap_cube "sky"', "neither", 'give either "filename"'),
    "both": Case(
        emitter(shapes="a", filename=lambda s: s.state), '"sky"', "both", 'give either "filename"'
    ),
    "no ids": Case(emitter(shapes=" , "), '"sky": "shapes"', "' , '", "must list ids"),
    # ---- Scenes ----
    "no surfaces": Case(
        lambda _: check_scene(load({"type": "scene", "sky": {"type": "constant"}}), "ours"),
        "ours", "the scene has no surfaces", "add a shape",
    ),
    "no emitters": Case(scene(lamp=None), "ours", "the scene has no emitters", "add one"),
    "no faces": Case(faceless, "ours", 'shape "nothing" is a mesh without faces', "remove it"),
    "cluster": Case(scene(desk=cluster("ball")), '"desk"', 'lists "shapes"', "put it inside the"),
    "cluster as light": Case(
        lambda _: mi.load_dict(cluster("ball") | {"id": "desk"}).eval_level(mi.Vector3f(1), 0),
        '"desk"', "emits nothing", 'or give it a "filename"',
    ),
    "medium": Case(
        scene(fog=ball(0, 0, 0, 0.3) | {"interior": MEDIUM}),
        'shape "fog"', 'HomogeneousMedium as "interior"', "remove it or use volpath",
    ),
    "camera in a medium": Case(
        lambda s: scene(sensor=camera(medium=MEDIUM))(s),
        'sensor "sensor"', "medium", "remove it or use volpath",
    ),
    "unknown shape": Case(listed("bal"), 'mipmap_cube "desk"', '"bal"', 'it has "ball"'),
    "unknown exception": Case(
        lambda _: integrator("envmap_hybrid", **SETTINGS, no_cluster="bal").prepare(load(room())),
        'envmap_hybrid: "no_cluster"', '"bal"', 'it has "ball"',
    ),
    "listed and excluded": Case(
        lambda _: integrator("envmap_hybrid", **SETTINGS, no_cluster="ball"),
        '"no_cluster" names shape "ball"', 'mipmap_cube "desk"', "leave it out of one",
    ),
    "listed twice": Case(listed("ball", "ball"), '"desk"', '"ball" is listed twice', "list it "),
    # ---- What else isn't done ----
    "frozen": Case(frozen, "envmap_hybrid", "dr.freeze", "render outside of the frozen function"),
    "gradients": Case(differentiated, "envmap_hybrid", "can't be differentiated", "use prb for"),
    "no sensor": Case(
        nested_without_sensor, "envmap_hybrid", "there are none", "add the sensor to the scene"
    ),
    "no pixels": Case(
        rendered(0, 24), 'the film of sensor "sensor"', "0 x 24", '"height" to 1 or more'
    ),
    "no samples": Case(
        rendered(sampler={"type": "independent", "sample_count": 0}),
        'the sampler of sensor "sensor"', "0 samples per pixel", '"sample_count" to 1 or more',
    ),
    # ---- The machine ----
    "variant": Case(other_variant, "envmap_hybrid", "variant scalar_rgb", "use one of llvm_ad_rgb"),
    "llvm": Case(old_llvm, "llvm_* variants", "LLVM 15", "need LLVM 17 or newer: "),
    "denoiser": Case(without_denoiser, "the denoiser", "is missing", "pip install mitsuba-oidn"),
    "samples": Case(
        too_many_samples, '"sampler" independent', "not 9", "leave it out to take any number"
    ),
    "patches": Case(
        little_memory(lambda s: integrator("envmap_hybrid", patches=10**6).prepare(load(room()))),
        "envmap_hybrid", "1000000 patches with 32 samples each need 11.4 GB, 1.0 GB are free",
        'lower "patches" or "patch_samples"',
    ),
    "maps": Case(
        little_memory(
            lambda s: integrator("envmap_hybrid", **SETTINGS | {"map_resolution": 2048}).prepare(
                load(room())
            )
        ),
        "envmap_hybrid", "1 maps of 2048 x 2048 texels a face need 3.3 GB, 1.0 GB are free",
        'lower "map_resolution" or list fewer clusters',
    ),
    # ---- Files that are read ----
    "a large file": Case(
        little_memory(use(lambda s: s.state), 1000), '"cache_file" {state}', "0.0 GB that are free",
        "close other programs",
    ),
    "no file": Case(use(lambda s: s.folder / "none.exr"), "none.exr", "no such file", AGAIN),
    "unreadable": Case(read_hidden, "{public}/state.exr", "Permission denied", "make it again"),
    "damaged": Case(use(with_bytes(lambda b: b[:-9])), STATE, "truncated or damaged", AGAIN),
    "no EXR": Case(use(with_bytes(lambda b: b"text")), STATE, "no OpenEXR file", AGAIN),
    "not ours": Case(
        use(with_bytes(lambda b: b.replace(b"envmap_integrator", b"envmap_integratos"))),
        STATE, "not a file of envmap_integrator", AGAIN,
    ),
    "format": Case(
        use(with_bytes(lambda b: b.replace(FORMAT, b'{"format": 0'))),
        STATE, f"written in format 0, this version reads format {storage.FORMAT}", AGAIN,
    ),
    "forged": Case(use(with_bytes(forged)), STATE, "not as this version writes", AGAIN),
    "other views": Case(
        seen_from_elsewhere, '"cache_file" {folder}/state.exr', "other views", AGAIN
    ),
    "another scene": Case(use(altered(setting("scene", "a"))), STATE, "another scene", AGAIN),
    "no such cluster": Case(
        rebake("chair", lambda s: s.state),
        "{state}", 'no cluster "chair", but desk', "name one of them",
    ),
    "another cache": Case(
        rebake("desk", altered(brighter)), "altered.exr", "another irradiance cache",
        "bake it whole",
    ),
    "sources": Case(
        use(altered(wrong_rows)), STATE, "rows for 1 emitters", AGAIN
    ),
    "map channels": Case(use(altered(grey_map)), STATE, "haven't 3 colour channels", AGAIN),
    "short": Case(use(altered(setting("patches", 10**6))), STATE, "values of 1000000", AGAIN),
    "clusters": Case(use(altered(no_maps)), STATE, "more than its 0 maps", AGAIN),
    "map resolution": Case(
        use(altered(setting("resolution", 3, "maps"))), STATE, '"resolution"', AGAIN
    ),
    "map size": Case(use(altered(half_map)), STATE, '"map0/level0" has another size', AGAIN),
    "no part": Case(
        use(altered(lambda parts, _: parts.pop("levels"))), STATE, 'no part "levels"', AGAIN
    ),
    "value": Case(use(altered(setting("size", "big"))), STATE, "not 'big'", AGAIN),
    "unknown map": Case(
        emitter(filename=lambda s: s.state, map="sofa"), "{state}", '"sofa", only desk', "name one"
    ),
    "no maps": Case(
        emitter(filename=altered(no_maps)), 'mipmap_cube "sky": {folder}/altered.exr',
        "holds no maps", 'set "maps" to "always"',
    ),
    "a picture that is no cube": Case(
        emitter(filename=plain_picture((6, 2))), 'mipmap_cube "sky": {folder}/plain.exr',
        "holds no cube map", "of six square faces one above the other",
    ),
    "a cube map with a name": Case(
        emitter(filename=plain_picture((12, 2)), map="sofa"), "{folder}/plain.exr", '"sofa"',
        'leave "map" out',
    ),
    "no picture": Case(
        emitter(filename=with_bytes(lambda b: b"text")), "altered.exr", "no OpenEXR file",
        "make it with",
    ),
    "map of another variant": Case(
        emitter(filename=altered(grey_map)),
        "mipmap_cube", "1 colour channels, variant llvm_ad_rgb needs 3", "bake it with this",
    ),
    "progress of another seed": Case(
        resumed(lambda parts, metadata: None, seed=1),
        "{folder}/room.progress.exr", "seed=0, not seed=1", "begin anew, without resume",
    ),
    "progress of another size": Case(
        resumed(half_sum), "room.progress.exr", "aren't 32 x 24", "begin anew, without resume"
    ),
    # ---- Files that are written ----
    "no folder": Case(
        lambda s: check_writable(s.folder / "a" / "b.exr"), "a/b.exr", "no folder", "make it first"
    ),
    "a folder": Case(
        lambda s: check_writable(s.folder), "{folder}", "is a folder", "choose another name"
    ),
    "protected": Case(
        write_protected, "{public}/state.exr", "the folder {public}", "change its permissions or"
    ),
    "full": Case(
        fill_the_disk, "{folder}/state.exr", "No space left on device", "make room there or choose"
    ),
    # ---- The shell ----
    "no scene": Case(
        lambda s: SceneFile(s.folder / "none.xml"), "scene", "none.xml", "check the path"
    ),
    "no root": Case(
        xml('<bsdf version="3.0.0" type="plastic"/>'), "scene.xml", '"plastic"', "be a <scene>"
    ),
    "assignment": Case(lambda _: parse_assignment("a"), '"a"', '"a"', "expected KEY=VALUE"),
    "no such child": Case(
        shell(commands.bake, integrator="envmap_hybrid", set=[("desk.resolution", 8)]),
        '"desk.resolution"', 'holds no "desk"', 'set "desk.shapes" too',
    ),
    "spp": Case(shell(commands.render, spp=-1), "--spp", "-1", "must not be negative"),
    "threads": Case(shell(commands.render, threads=0), "--threads", "0", "must be at least 1"),
    "mode": Case(shell(commands.render, mode="gpu"), "variant", '"gpu"', "choose from"),
    "sensor": Case(shell(commands.render, sensor=1), "--sensor", "sensor 1", "the scene has 1; "),
    "no sensors": Case(
        lambda _: integrator("one_level_path").render(load(room(sensor=None))),
        "the scene", "no sensor", "add one",
    ),
    "output": Case(shell(commands.bake, output="b.png"), "output", "b.png", "must end in .exr"),
    "page": Case(shell(commands.inspect, output="b.exr"), "output", "b.exr", "must end in .html"),
    "spp of a page": Case(
        shell(commands.inspect, output="b.html", spp=-1), "--spp", "-1", "must not be negative"
    ),
    "nothing to inspect": Case(
        shell(commands.inspect, output="b.html", integrator="path"), "integrator", '"path"',
        "pass --integrator envmap_hybrid",
    ),
    "nothing to inspect, from Python": Case(
        lambda _: inspect("a.html", load(room()), mi.load_dict({"type": "path"})),
        "integrator", '"PathIntegrator"', "pass integrator=mi.load_dict",
    ),
    "no templates": Case(without_jinja, "jinja2", "is missing", "pip install jinja2"),
    "no colour": Case(
        shell(commands.render, denoise=True), "--denoise", "1 channel(s)", "to rgb or rgba"
    ),
    "a picture that cannot improve": Case(
        shell(commands.render, progressive=True), "integrator", '"path"',
        "pass --integrator envmap_hybrid",
    ),
    "denoised while it improves": Case(
        shell(commands.render, integrator="envmap_hybrid", progressive=True, denoise=True),
        "--denoise", "one picture", "leave out --progressive, --time and --target-error",
    ),
    "bands in the infrared": Case(
        on_bands(700, 900), "one_level_path: the film", "700 nm to 900 nm", "narrow the bands"
    ),
    "bands and colours": Case(
        on_bands(500, 600, indirect_aovs=True),
        "one_level_path", '"indirect_aovs"', "take a hdrfilm",
    ),
    "a PNG of bands": Case(png_of_bands, "--png", "holds bands", "take a hdrfilm"),
    "no time": Case(
        shell(commands.render, integrator="envmap_hybrid", time=0.0), "--time", "0.0", "above 0"
    ),
    "no samples a pass": Case(progressive(spp=0), "one_level_path", '"spp"', "at least 1, not 0"),
    "a negative error": Case(
        progressive(target_error=-1.0), '"target_error" or --target-error', "-1.0", "left out"
    ),
    "samples that end": Case(
        progressive(sampler="independent"),
        "one_level_path", '"sampler" independent', "leave it out",
    ),
    # ---- Workers ----
    "a worker of another version": Case(
        another_version, "worker tcp://there:2", "mitsuba 3.8.0", "install that version there"
    ),
    "a worker with a fault": Case(
        answered(outcome=Outcome("tcp://there:2", None, "has no scene; copy it")),
        "worker tcp://there:2", "has no scene", "copy it",
    ),
    "workers that die": Case(
        answered("error", error=died()), "tcp://there:2", "workers die", "give it more memory"
    ),
    "workers that fail": Case(
        answered("error", error=MemoryError("no memory")), "a worker", "no memory", "see its log"
    ),
    "lost results": Case(
        answered(error=OSError("gone")), "results", f"{tasks.MOST_TRIES} times", "see the logs"
    ),
    "a hung worker": Case(hung, "worker tcp://there:2", "no result within 9 s", "see the logs"),
    "no scheduler any more": Case(
        looked_after(status="closed"), "tcp://here:1", "scheduler is gone", "start it again"
    ),
    "a scheduler that hangs": Case(
        silent_scheduler, "tcp://here:1", "doesn't answer", "start it again"
    ),
    "no worker any more": Case(
        looked_after(), "tcp://here:1", "no worker is left", "start some there"
    ),
    "no worker that has memory": Case(
        looked_after({"tcp://there:2": {"status": "paused"}}),
        "worker tcp://there:2", "short of its memory limit", "dask worker --memory-limit",
    ),
    "no worker": Case(nobody_comes, "tcp://here:1", "no worker has come within 60 s", "start some"),
    "no scheduler": Case(
        scheduler_that_fails("[Errno 111] refused"),
        "tcp://there:1", "no scheduler answers", "start one with: dask scheduler",
    ),
    "a scheduler with TLS": Case(
        scheduler_that_fails("ConnectionResetError: reset by peer"),
        "tcp://there:1", "no scheduler answers", "use its address tls://there:1",
    ),
    "certificates of others": Case(
        scheduler_that_fails("TLS certificate does not match"),
        "tcp://there:1", "certificate does not match", "signed by the authority that both name",
    ),
    "no address": Case(scheduler_at("render-1"), "a scheduler", '"render-1"', "tcp://render-1:8786"),
    "certificates without TLS": Case(
        scheduler_at("tcp://there:1", ("ca", "cert", "key")), "certificates", "tcp://", "tls://"
    ),
    "TLS without certificates": Case(
        scheduler_at("tls://there:1"), "tls://there:1", "certificates", "pass --tls CA CERT KEY"
    ),
    "missing certificates": Case(
        scheduler_at("tls://there:1", ("none.pem", "none.pem", "none.pem")),
        "no file", "none.pem", "takes CA, CERT and KEY",
    ),
    "damaged certificates": Case(
        scheduler_at("tls://there:1", (__file__,) * 3), "TLS files", "test_messages.py", "your key"
    ),
    "certificates for nobody": Case(
        shell(commands.render, tls=["ca", "cert", "key"]), "--tls", "--cluster", "leave it out"
    ),
    "path in parts": Case(
        in_parts("path"), "MonteCarloIntegrator", "in parts", "take envmap_hybrid"
    ),
    "a sampler in parts": Case(
        in_parts("one_level_path", sampler="independent"),
        "one_level_path", '"sampler" independent', "leave it out",
    ),
    "another sensor": Case(no_such_sensor, "sensor 3", "the scene has 1", "count from 0"),
    "no Dask": Case(without_dask, "Dask", "is missing", "pip install distributed"),
    "no workers": Case(shell(commands.render, workers=0), "--workers", "0", "must be at least 1"),
    "no clusters": Case(
        shell(commands.bake, integrator="one_level_path", clusters="desk"),
        "--clusters", '"one_level_path" has none', "pass --integrator envmap_hybrid",
    ),
    "nothing to bake": Case(
        shell(commands.bake), "integrator", '"path"', "pass --integrator envmap_hybrid"
    ),
}  # fmt: skip


# ---------------------- What holds for all ----------------------


def sites() -> dict[Site, str]:
    """Where the package raises errors: (file, line) → the statement."""
    found = {}
    for path in PACKAGE.rglob("*.py"):
        source = path.read_text()
        for node in ast.walk(ast.parse(source)):
            function = getattr(getattr(node, "func", None), "id", "")
            if isinstance(node, ast.Raise) or function == "_require":
                statement = ast.get_source_segment(source, node)
                if statement not in EXCEPTED:
                    found[str(path.relative_to(PACKAGE)), node.lineno] = statement
    return found


def raised_by(action: Callable[[], object]) -> list[tuple[Site, str]]:
    """Where in the package exceptions came by during an action, and their messages.

    On their way through Mitsuba they lose what Python knows of them, so they are watched.
    """
    seen = []

    def watch(frame, event, argument):
        if event == "exception":
            path = Path(frame.f_code.co_filename).relative_to(PACKAGE)
            seen.append(((str(path), frame.f_lineno), str(argument[1])))
        return watch

    def enter(frame, event, argument):
        return watch if frame.f_code.co_filename.startswith(str(PACKAGE)) else None

    before = sys.gettrace()
    sys.settrace(enter)
    try:
        action()
    except (ValueError, TypeError, RuntimeError, ImportError, OSError, argparse.ArgumentTypeError):
        return seen
    finally:
        sys.settrace(before)
    pytest.fail("nothing was raised")


SITES = sites()
_hit: set[Site] = set()


@pytest.fixture(scope="module")
def state(variant, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("state") / "state.exr"
    integrator("envmap_hybrid", **SETTINGS).prepare(load(room())).save(path)
    return path


@pytest.mark.parametrize("name", CASES)
def test_a_message_names_object_value_and_mend(name, tmp_path, public_folder, state, monkeypatch):
    case = CASES[name]
    surroundings = Surroundings(tmp_path, public_folder, state, monkeypatch)
    seen = [
        (site, message)
        for site, message in raised_by(lambda: case.action(surroundings))
        if site in SITES
    ]
    assert seen
    _hit.update(site for site, _ in seen)
    message = seen[-1][1]
    for words in (case.object, case.value, case.mend):
        assert words.format(folder=tmp_path, public=public_folder, state=state) in message
    assert "\n" not in message and len(message) < 500


def test_every_error_has_a_case(request):
    """Needs the whole module to have run."""
    module = [item for item in request.session.items if item.path == request.node.path]
    if len(module) <= len(CASES):
        pytest.skip("a part of the cases was deselected")
    missing = {f"{file}:{line}  {SITES[file, line]}" for file, line in SITES.keys() - _hit}
    assert not missing
