"""What a worker has to know to render a scene, and whether it can."""

from __future__ import annotations

import platform
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

import envmap_integrator

from ..imaging.denoiser import prepare_for_denoiser
from ..system.checks import sensor_of
from ..system.llvm import LLVMError, ensure_llvm
from ..system.scene_file import SceneFile


def environment() -> dict[str, str]:
    """What pictures depend on to the last bit besides the scene: versions and kind of CPU."""
    simd = np.show_config(mode="dicts")["SIMD Extensions"]
    return {
        "envmap_integrator": envmap_integrator.__version__,
        "mitsuba": mi.__version__,
        "drjit": dr.__version__,
        "LLVM": ".".join(map(str, dr.detail.llvm_version())),
        "numpy": np.__version__,  # Which names the CPU.
        "CPU": " ".join([platform.machine(), *simd["baseline"], *simd["found"]]),
    }


@dataclass(frozen=True)
class Job:
    """A scene to render: plain values, never objects of a scene that is loaded.

    scene         absolute path of its XML file, the same on all machines
    variant       of Mitsuba
    parameters    values of the scene's ``$name`` place-holders
    integrator    plugin that replaces the scene's, or None
    settings      parameters of the integrator
    denoise       films get a box filter, pictures what the denoiser takes
    content       hash of the scene file and of the files that it names
    environment   of the process that asks for the picture
    """

    scene: str
    variant: str
    parameters: Mapping[str, str] = field(default_factory=dict)
    integrator: str | None = None
    settings: Mapping[str, Any] = field(default_factory=dict)
    denoise: bool = False
    content: str = ""
    environment: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        scene: str | Path,
        parameters: Mapping[str, str] | None = None,
        integrator: str | None = None,
        settings: Mapping[str, Any] | None = None,
        denoise: bool = False,
    ) -> Job:
        """A job for this process's variant; see ``render_distributed``."""
        asked = cls(
            str(Path(scene).resolve()),
            mi.variant(),
            parameters=dict(parameters or {}),
            integrator=integrator,
            settings=dict(settings or {}),
            denoise=denoise,
        )
        content = asked._file().content_hash()
        return cls(**vars(asked) | {"content": content, "environment": environment()})

    def fault(self) -> str:
        """Why this process can't make the same picture, and the fix; nothing if it can."""
        if self.variant.startswith("llvm_"):
            try:
                ensure_llvm()
            except LLVMError as error:
                return str(error)
        for name, theirs in environment().items():
            asked = self.environment[name]
            if theirs != asked and name == "CPU":
                return (
                    f"another kind of CPU ({theirs}) than where the picture is asked for ({asked}) "
                    "would give other last bits; use machines of one kind"
                )
            if theirs != asked:
                return f"has {name} {theirs} instead of {asked}; install that version there"
        mi.set_variant(self.variant)
        if not Path(self.scene).is_file():
            return f'there is no scene file "{self.scene}"; put it there, under the same path'
        if self._file().content_hash() != self.content:
            return (
                f'the scene file "{self.scene}", or a file that it names, has other content than '
                "where the picture is asked for; copy the scene's folder"
            )
        return ""

    def load(self) -> mi.Scene:
        """The scene. Meshes aren't merged: else a baked state needn't fit in other processes."""
        threads = dr.thread_count()
        # With a single thread, Mitsuba may wait for ever for what it loads in parallel.
        dr.set_thread_count(max(threads, 2))
        scene = self._file().load(merge_meshes=False)
        dr.set_thread_count(threads)
        if self.denoise:
            prepare_for_denoiser(scene.integrator())
        return scene

    def _file(self) -> SceneFile:
        scene_file = SceneFile(Path(self.scene), self.parameters)
        scene_file.configure_integrator(self.integrator, self.settings)
        if self.denoise:
            scene_file.configure_reconstruction_filters("box")
        return scene_file


@dataclass(frozen=True)
class View:
    """A sensor of the scene, at its own place or at that of ``to_world`` [4, 4], row by row."""

    sensor: int = 0
    to_world: tuple[float, ...] | None = None

    @contextmanager
    def of(self, scene: mi.Scene) -> Iterator[mi.Sensor]:
        """That sensor, for the block at that place; ``ValueError`` if the scene has none such."""
        sensor = sensor_of(scene, self.sensor)
        if self.to_world is None:
            yield sensor
            return
        parameters = mi.traverse(sensor)
        home = mi.Transform4f(parameters["to_world"])
        matrix = np.reshape(self.to_world, (4, 4)).astype(np.float32)
        parameters["to_world"] = mi.Transform4f(mi.Matrix4f(matrix))
        parameters.update()
        try:
            yield sensor
        finally:
            parameters["to_world"] = home
            parameters.update()
