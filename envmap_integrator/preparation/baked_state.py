"""The baked state of a scene: what it depends on, what it holds, and its files."""

from __future__ import annotations

import json
import math
import os
import time
from collections.abc import Collection
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..lookup.cube_map import CubeMap, from_stored, to_parts
from ..lookup.irradiance_cache import IrradianceCache
from ..lookup.patches import BUCKET, Patches
from ..system.fingerprint import difference
from ..system.jit import opaque_point, upload
from ..system.spectrum import n_stored
from ..system.storage import StorageError, Stored, read, write
from .maps.clusters import ClusterRequest
from .views import Service

#: Patches that a render is worth, at least and at most, and camera samples for which there is one.
#: Renders of nearly the same size get the same: there are few steps of the size in between.
LEAST_PATCHES, MOST_PATCHES, SAMPLES_PER_PATCH = 8192, 16384, 1536
STEPS_PER_OCTAVE = 2
#: Gather rays for each camera sample, about; of a patch at most: all are kept until it's solved.
GATHER_SHARE, MOST_PATCH_SAMPLES = 1 / 16, 256
#: Gather rays that may be added for each camera sample, and at least and at most in all.
MORE_SHARE, LEAST_MORE, MOST_MORE = 1 / 4, 1 << 21, 1 << 23


@dataclass(frozen=True)
class Settings:
    """What the pre-passes depend on besides the scene; see the integrators for the meanings.

    ``patches`` and ``patch_samples`` are None until the size of a render decides, which also gives
    ``more_rays``: gather rays that may be added where light is rare.
    """

    patches: int | None
    patch_samples: int | None
    least_patch_samples: int
    more_rays: int = 0
    maps: bool = False
    map_resolution: int = 0
    map_samples: int = 0
    map_shadow_samples: int = 1
    distance_ratio: float = 0.0
    map_mirrors: bool = False
    map_always: bool = False
    requests: tuple[ClusterRequest, ...] = ()
    no_cluster: tuple[str, ...] = ()

    def for_render(self, n_samples: int) -> Settings:
        """With a coarse mesh and a cache as fine as so many camera samples are worth.

        So the pre-passes take a small part of the time of a render, and their error falls with its
        noise.
        """
        patches = self.patches
        if patches is None:
            worth = max(n_samples / SAMPLES_PER_PATCH / LEAST_PATCHES, 1)
            octaves = round(STEPS_PER_OCTAVE * math.log2(worth)) / STEPS_PER_OCTAVE
            patches = min(int(LEAST_PATCHES * 2**octaves), MOST_PATCHES)
        samples = self.patch_samples
        if samples is None:
            most = int(GATHER_SHARE * n_samples / patches)
            samples = max(1 << most.bit_length() >> 1, self.least_patch_samples)
            samples = min(samples, MOST_PATCH_SAMPLES)
        more = min(max(int(MORE_SHARE * n_samples), LEAST_MORE), MOST_MORE)
        more = LEAST_MORE if self.patch_samples else 1 << more.bit_length() - 1
        return replace(self, patches=patches, patch_samples=samples, more_rays=more)


@dataclass(frozen=True)
class StateKey:
    """What a baked state belongs to.

    scene      fingerprint of the scene's content
    settings   what was asked for, before the size of a render has decided
    """

    scene: str
    settings: Settings

    def refuses(self, scene: str, settings: dict[str, Any], but: Collection[str] = ()) -> str:
        """How the key of a stored state, as plain values, differs; nothing if it's the same.

        ``but`` are names of clusters that may have been asked for otherwise.
        """
        if scene != self.scene:
            differing = difference(scene, self.scene)
            return "made for another scene" + (f": it has other {differing}" if differing else "")
        theirs, ours = _flat(settings), _flat(_plain(self.settings))
        for name in ours | theirs:
            if theirs.get(name) != ours.get(name) and name.rpartition(".")[0] not in but:
                return _refusal(name, theirs.get(name), ours.get(name))
        return ""


@dataclass(frozen=True)
class BakedState:
    """The baked state of a scene, for all views of what some sensors see.

    key                what it belongs to
    cache              irradiance on the patches
    emitter_table      [R * L * 4]  probabilities of the emitters (``EmitterChoice.table``),
    emitter_rows       [C]          ... and which row is each large cell's
    views              names (``view_name``) of the sensors that it was made for,
    service            ... and what it does for them
    relative_error     [1]          error of the brightness of their pictures, of the worst, that
                                    comes from the noise of the cache and the size of the patches;
                                    of another view's, if it's the state for that
    size_error         [1]          ... from the latter alone, as far as it's beyond doubt
    maps               one cube map per cluster
    cluster_of_cell    cluster index of each large cell, ``len(maps)`` where there is none
    stage_times        seconds spent in each stage; of a state from a file, on reading that
    """

    key: StateKey
    cache: IrradianceCache
    emitter_table: mi.Float
    emitter_rows: mi.UInt32
    views: tuple[str, ...]
    service: Service
    relative_error: float
    size_error: float
    maps: tuple[CubeMap, ...] = ()
    cluster_of_cell: np.ndarray | None = None
    stage_times: dict[str, float] = field(default_factory=dict)

    def save(self, path: str | os.PathLike) -> None:
        """Write the state to an OpenEXR file, for ``cache_file`` and ``mipmap_cube``."""
        save(path, self)


# ---------------------- Files ----------------------

#: Width of the images that hold one-dimensional arrays.
_WIDTH = 1024


def save(path: str | os.PathLike, prepared: BakedState) -> None:
    """Write a prepared state to an OpenEXR file."""
    patches = prepared.cache.patches
    parts = {
        "patches": {"fingerprint": _image(patches.cells.numpy())},
        "levels": {"entry": _image(patches.levels.numpy())},
        "irradiance": {"Y": _image(prepared.cache.table.numpy())},
        "irradiance_error": {"Y": _image(prepared.cache.error.numpy())},
        "sources": {"alias": _image(prepared.emitter_table.numpy())},
        "emitter_rows": {"row": _image(prepared.emitter_rows.numpy())},
    }
    if prepared.cluster_of_cell is not None:
        parts["cluster_of_cell"] = {"cluster": _image(prepared.cluster_of_cell)}
    maps = []
    for index, cube_map in enumerate(prepared.maps):
        map_parts, map_metadata = to_parts(cube_map, prefix=f"map{index}/")
        parts |= map_parts
        maps.append(map_metadata)
    metadata = {
        "scene": prepared.key.scene,
        "asked": [_plain(prepared.key.settings)],
        "origin": [float(c[0]) for c in patches.origin],
        "size": float(patches.size[0]),
        "levels": dr.width(patches.levels),
        "patches": patches.count,
        "use_objects": patches.use_objects,
        "channels": n_stored(),
        "sources": dr.width(prepared.emitter_table),
        "emitter_rows": dr.width(prepared.emitter_rows),
        "views": list(prepared.views),
        "service": [asdict(prepared.service)],
        "relative_error": prepared.relative_error,
        "size_error": prepared.size_error,
        "maps": maps,
        "stage_times": prepared.stage_times,  # For people: nothing reads them.
    }
    write(path, parts, metadata)


def load(
    path: str | os.PathLike,
    key: StateKey,
    owner: str,
    n_emitters: int,
    but: Collection[str] = (),
) -> BakedState:
    """Read a prepared state; ``ValueError`` if the file holds none that belongs to ``key``.

    ``n_emitters`` is the number of emitters of the scene; ``owner`` wants the file; ``but`` are
    those of ``StateKey.refuses``.
    """
    begin = time.perf_counter()
    path = mi.file_resolver().resolve(str(path))
    try:
        stored = read(path, "make it again with envmap-render bake")
        state = _prepared(stored, key, n_emitters, but)
    except StorageError as error:
        raise ValueError(f"{owner} {error}") from None
    return replace(state, stage_times={f"read from {path}": time.perf_counter() - begin})


def _prepared(stored: Stored, key: StateKey, n_emitters: int, but: Collection[str]) -> BakedState:
    (asked,) = stored.entries("asked")
    difference = key.refuses(stored.text("scene"), asked.metadata, but)
    if difference:
        raise stored.refusal(difference)

    def values(part, channel, dtype, count):
        found = stored.array(part, channel, dtype).ravel()[:count]
        if len(found) < count:
            raise stored.refusal(f'its part "{part}" holds {len(found)} values of {count}')
        return found

    n_cells = stored.integer("levels", BUCKET)
    n_patches = stored.integer("patches", BUCKET)
    n_channels = n_stored()
    patches = Patches(
        origin=opaque_point(stored.point("origin")),
        size=dr.opaque(mi.Float, stored.number("size")),
        levels=upload(mi.UInt32, values("levels", "entry", np.uint32, n_cells)),
        cells=upload(mi.UInt32, values("patches", "fingerprint", np.uint32, n_patches)),
        use_objects=stored.flag("use_objects"),
    )
    table = values("irradiance", "Y", np.float32, 2 * n_patches * n_channels)
    error = values("irradiance_error", "Y", np.float32, 2 * n_patches)

    # What kernels look up has to be there: they don't check.
    n_sources = stored.integer("sources", 4 * n_emitters)
    sources = values("sources", "alias", np.float32, n_sources)
    rows = values("emitter_rows", "row", np.uint32, stored.integer("emitter_rows", 1))
    other = sources[1::4]
    n_rows = n_sources // (4 * n_emitters)
    if rows.max() >= n_rows or not np.all((other >= 0) & (other < n_emitters)):
        raise stored.refusal(f"its sources aren't {n_rows} rows for {n_emitters} emitters")
    maps = tuple(
        from_stored(entry, prefix=f"map{index}/")
        for index, entry in enumerate(stored.entries("maps"))
    )
    if any(cube_map.n_channels != n_channels for cube_map in maps):
        raise stored.refusal(f"its maps haven't {n_channels} colour channels")
    (service,) = stored.entries("service")
    membership = None
    if maps or "cluster_of_cell" in stored.parts:
        membership = values("cluster_of_cell", "cluster", np.uint32, n_cells)
        if membership.max() > len(maps):
            raise stored.refusal(f"its clusters are more than its {len(maps)} maps")
    return BakedState(
        key,
        IrradianceCache.of(patches, upload(mi.Float, table), upload(mi.Float, error)),
        upload(mi.Float, sources),
        upload(mi.UInt32, rows),
        tuple(stored.texts("views")),
        Service(*(service.number(name) for name in ("found", "patches", "error"))),
        stored.number("relative_error"),
        stored.number("size_error"),
        maps,
        membership,
    )


def _plain(settings: Settings) -> dict[str, Any]:
    """Settings as JSON gives them back."""
    return json.loads(json.dumps(asdict(settings)))


def _flat(settings: dict[str, Any]) -> dict[str, Any]:
    """The same with those of each listed cluster by themselves, as ``cluster.name``."""
    found = {name: value for name, value in settings.items() if name != "requests"}
    requests = settings.get("requests")
    for request in requests if isinstance(requests, list) else [requests]:
        its = request if isinstance(request, dict) else {"": request}  # Files may hold anything.
        found |= {f"{its.get('name')}.{name}": value for name, value in its.items()}
    return found


#: Names and values that users give settings, where these have others.
_AS_GIVEN = {
    "map_samples": ("baker.samples", {}),
    "map_shadow_samples": ("baker.shadow_samples", {}),
    "map_mirrors": ("mirrors", {"True": "map", "False": "trace"}),
    "map_always": ("maps", {"True": "always", "False": "auto"}),
}


def _refusal(name: str, theirs: Any, ours: Any) -> str:
    """How a setting of ``_flat`` differs, and what to do, in words that users know."""
    if name == "maps":
        if theirs:
            return "made for an integrator with maps (use envmap_hybrid)"
        return "made for an integrator without maps (use the same one, such as one_level_path)"
    if name == "least_patch_samples":
        return "made for another integrator (use the same one)"
    cluster, _, part = name.rpartition(".")
    if part == "name" and ours is None:
        return (
            f'made with the cluster "{cluster}" listed, not without (pass the same --set '
            f'{cluster}.shapes=…, or nest the same <emitter type="mipmap_cube" id="{cluster}">)'
        )
    if part == "name":
        return f'made without the cluster "{cluster}" (leave its mipmap_cube or --set out)'
    name, words = _AS_GIVEN.get(name, (name, {}))
    its, other = (f"{name}={words.get(str(value), value)!r}" for value in (theirs, ours))
    made = f"with {its}" if theirs is not None else f"without {name}"
    asked = other if ours is not None else "without"
    return f"made {made}, not {asked} (pass the same settings as there)"


def _image(values: np.ndarray) -> np.ndarray:
    """A one-dimensional array as an image, padded with zeros."""
    height = max(-(-len(values) // _WIDTH), 1)
    image = np.zeros(height * _WIDTH, dtype=values.dtype)
    image[: len(values)] = values
    return image.reshape(height, _WIDTH)
