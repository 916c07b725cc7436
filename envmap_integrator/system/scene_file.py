"""A scene description that can be changed between parsing and loading."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import mitsuba as mi

DEFAULT_INTEGRATOR = "envmap_hybrid"


class SceneFile:
    """A parsed scene; each :meth:`load` makes new objects from it in the active variant.

    Its integrator is replaced *before* anything is loaded, so that a scene may name one that
    doesn't exist here. A scene without an integrator gets :data:`DEFAULT_INTEGRATOR`.

    Parameters: ``path`` of the XML file; ``parameters``, values of its ``$name`` place-holders.
    """

    def __init__(self, path: Path, parameters: Mapping[str, str] | None = None):
        if not path.is_file():
            raise FileNotFoundError(f'there is no scene file "{path}"; check the path')
        self._folder = path.parent
        self._config = mi.parser.ParserConfig(mi.variant())
        with _search_folder(self._folder):
            self._state = mi.parser.parse_file(self._config, str(path), **(parameters or {}))
        if self._state.root.type != mi.ObjectType.Scene:
            root = self._state.root.props.plugin_name()
            raise ValueError(
                f'the root element of "{path}" must be a <scene>, not of type "{root}"'
            )
        if not self._children(self._state.root, mi.ObjectType.Integrator):
            self._append_child(self._state.root, mi.ObjectType.Integrator, DEFAULT_INTEGRATOR)

    @property
    def integrator(self) -> mi.Properties:
        """Name and parameters of the integrator."""
        return self._integrator_node.props

    def configure_integrator(
        self,
        name: str | None = None,
        settings: Mapping[str, Any] | None = None,
        keep: bool = True,
    ) -> None:
        """Use the plugin ``name`` (None: the present one) and ``settings``.

        The present plugin's own parameters stay with it unless ``keep`` is False.
        """
        if name is not None and (name != self.integrator.plugin_name() or not keep):
            self._integrator_node.props = mi.Properties(name)
        for key, value in (settings or {}).items():
            self.integrator[key] = value

    @property
    def film_size(self) -> tuple[int, int]:
        """Width and height [pixels] of the first film; Mitsuba's default where it has none."""
        for node in self._state.nodes:
            if node.type == mi.ObjectType.Film:
                film = mi.Properties(node.props)
                return film.get("width", 768), film.get("height", 576)
        return 768, 576

    def configure_films(self, width: int, height: int) -> None:
        """Give every film this size [pixels], no crop window, and a box reconstruction filter."""
        for film in [node for node in self._state.nodes if node.type == mi.ObjectType.Film]:
            for key in [key for key in film.props.keys() if key.startswith("crop_")]:
                del film.props[key]
            film.props["width"], film.props["height"] = width, height
        self.configure_reconstruction_filters("box")

    def configure_reconstruction_filters(self, plugin: str) -> None:
        """Give every film this reconstruction filter."""
        for film in [node for node in self._state.nodes if node.type == mi.ObjectType.Film]:
            filters = self._children(film, mi.ObjectType.ReconstructionFilter)
            for node in filters:
                node.props = mi.Properties(plugin)
            if not filters:
                self._append_child(film, mi.ObjectType.ReconstructionFilter, plugin)

    def configure_samplers(self, plugin: str) -> None:
        """Have every sensor draw its sample points from ``plugin``; sample counts stay."""
        for sampler in [node for node in self._state.nodes if node.type == mi.ObjectType.Sampler]:
            count = sampler.props.get("sample_count", 16)
            sampler.props = mi.Properties(plugin)
            sampler.props["sample_count"] = count
        for sensor in [node for node in self._state.nodes if node.type == mi.ObjectType.Sensor]:
            if not self._children(sensor, mi.ObjectType.Sampler):
                self._append_child(sensor, mi.ObjectType.Sampler, plugin)

    def content_hash(self) -> str:
        """Hash of the description as it is now and of the files that it names."""
        digest = hashlib.blake2b(digest_size=10)
        for node in self._state.nodes:
            digest.update(str(node.props).encode())
            name = mi.Properties(node.props).get("filename")
            if name is not None and (self._folder / name).is_file():
                digest.update((self._folder / name).read_bytes())
        return digest.hexdigest()

    def load(self, merge_meshes: bool = True) -> mi.Scene:
        """Instantiate the scene.

        Meshes that share a material are merged, as by ``mi.load_file``, unless the integrator
        relies on what merging changes: the ids of shapes, and their order, which is then another
        one each time and would make a stored state useless.
        """
        stored = "cache_file" in self.integrator
        self._config.merge_meshes = merge_meshes and not stored and not self._lists_shapes()
        state = mi.parser.ParserState(self._state)
        with _search_folder(self._folder):
            mi.parser.transform_all(self._config, state)
            return mi.parser.instantiate(self._config, state)

    def _lists_shapes(self) -> bool:
        """Does the integrator hold clusters that the user has listed?"""
        emitters = self._children(self._integrator_node, mi.ObjectType.Emitter)
        return any("shapes" in emitter.props for emitter in emitters)

    @property
    def _integrator_node(self) -> mi.parser.SceneNode:
        return self._children(self._state.root, mi.ObjectType.Integrator)[0]

    def _children(
        self, parent: mi.parser.SceneNode, kind: mi.ObjectType
    ) -> list[mi.parser.SceneNode]:
        # A copy: Mitsuba takes what has been read for known, and would miss misspelt names.
        references = [
            value
            for _, value in mi.Properties(parent.props).items()
            if isinstance(value, mi.Properties.ResolvedReference)
        ]
        nodes = [self._state.nodes[reference.index()] for reference in references]
        return [node for node in nodes if node.type == kind]

    def _append_child(self, parent: mi.parser.SceneNode, kind: mi.ObjectType, plugin: str) -> None:
        # Link first: appending may move the nodes in memory, which invalidates `parent`.
        index = len(self._state.nodes)
        parent.props[f"_{plugin}"] = mi.Properties.ResolvedReference(index)
        node = mi.parser.SceneNode()
        node.type = kind
        node.props = mi.Properties(plugin)
        self._state.nodes.append(node)


@contextmanager
def _search_folder(folder: Path) -> Iterator[None]:
    """Let relative paths of a scene start at its own folder."""
    outer = mi.file_resolver()
    inner = mi.FileResolver(outer)
    inner.prepend(str(folder))
    mi.set_file_resolver(inner)
    try:
        yield
    finally:
        mi.set_file_resolver(outer)
