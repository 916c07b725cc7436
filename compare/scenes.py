"""What is rendered: a scene file, its size, its sample points."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import mitsuba as mi

from envmap_integrator.system.scene_file import SceneFile

OWN_SCENES = Path(__file__).parents[1] / "scenes"
PAPER_ROOM = OWN_SCENES / "paper_room.xml"

BEST_SAMPLER = "multijitter"
"""Of Mitsuba's samplers, the one with which ``path`` has the least error."""


PAPER_TABLE = ("table-top", *(f"table-leg-{i}" for i in range(1, 5)), "ball")
"""Ids of all that the paper has inside its cube."""

PAPER_CLUSTER = {"type": "mipmap_cube", "shapes": ", ".join(PAPER_TABLE)}
"""The paper's only cluster; ids need a view that doesn't merge meshes."""


@dataclass(frozen=True)
class View:
    """A scene as all integrators see it: the same film, box filter and sampler for each.

    path          scene description, XML
    width         of the film [pixels]; its height follows from the scene's own film
    parameters    values of its ``$name`` place-holders
    sampler       plugin that draws the sample points, unless integrators have their own
    merge_meshes  False keeps shapes apart, so that their ids can be used
    """

    path: Path
    width: int
    parameters: Mapping[str, str] = field(default_factory=dict)
    sampler: str = BEST_SAMPLER
    merge_meshes: bool = True

    @property
    def name(self) -> str:
        """Name of the file, or of its folder where the file is just called scene."""
        return self.path.stem if self.path.stem != "scene" else self.path.resolve().parent.name

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the film [pixels]."""
        width, height = SceneFile(self.path, self.parameters).film_size
        return self.width, max(round(self.width * height / width), 1)

    def load(self) -> mi.Scene:
        """A new scene; its own integrator is ``path`` without a limit of depth."""
        return self._file().load(self.merge_meshes)

    def content_hash(self) -> str:
        """Changes with everything that the picture depends on, but for the samples."""
        return self._file().content_hash()

    def hides_emitters(self) -> bool:
        """Does the scene's integrator hide directly visible emitters?"""
        own = SceneFile(self.path, self.parameters).integrator
        return bool(own["hide_emitters"]) if "hide_emitters" in own else False

    def _file(self) -> SceneFile:
        scene_file = SceneFile(self.path, self.parameters)
        # Ours have no limit of depth, so path gets none either.
        hidden = self.hides_emitters()
        scene_file.configure_integrator("path", {"hide_emitters": hidden}, keep=False)
        scene_file.configure_films(*self.size)
        scene_file.configure_samplers(self.sampler)
        return scene_file


@dataclass(frozen=True)
class Subject:
    """An integrator with its settings, as ``mi.load_dict`` takes them."""

    integrator: str
    settings: Mapping[str, Any] = field(default_factory=dict)
    label: str = ""

    @property
    def name(self) -> str:
        """How tables and plots call it."""
        return self.label or self.integrator

    @classmethod
    def parse(cls, text: str) -> Subject:
        """As on the command line: ``one_level_path`` or ``one_level_path:patches=4096,…``.

        Raises ``ValueError`` for anything else.
        """
        integrator, _, listed = text.partition(":")
        settings = {}
        for setting in filter(None, listed.split(",")):
            name, equals, value = setting.partition("=")
            if not (name and equals and value):
                raise ValueError(f'"{text}": give settings as {integrator}:name=value,name=value')
            settings[name] = _value(value)
        return cls(integrator, settings, text if settings else "")

    def make(self, hide_emitters: bool = False) -> mi.Integrator:
        """A new integrator: nothing is prepared yet."""
        return mi.load_dict(
            {"type": self.integrator, "hide_emitters": hide_emitters, **self.settings}
        )


def _value(text: str) -> bool | int | float | str:
    """The value of a setting."""
    if text in ("true", "false"):
        return text == "true"
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return text


PATH = Subject("path")
HYBRID = Subject("envmap_hybrid")
ONE_LEVEL_PATH = Subject("one_level_path")
SOURCE_SELECTION = Subject("source_selection")
