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

        The present plugin's own parameters stay with it unless ``keep`` is False. ``a.b`` is
        parameter ``b`` of what is nested in the integrator as ``a``; ``a.shapes`` makes it, if
        there is none. Raises ``ValueError`` if there is none.
        """
        if name is not None and (name != self.integrator.plugin_name() or not keep):
            self._integrator_node.props = mi.Properties(name)
        settings = settings or {}
        # Shapes first: they may make what the others are parameters of.
        for key in sorted(settings, key=lambda key: not key.endswith(".shapes")):
            child, dot, parameter = key.rpartition(".")
            props = self._nested(child, parameter) if dot else self.integrator
            props[parameter] = settings[key]

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
        """Does the integrator name shapes, in clusters that the user has listed or excluded?"""
        emitters = self._children(self._integrator_node, mi.ObjectType.Emitter)
        listed = any("shapes" in emitter.props for emitter in emitters)
        return listed or "no_cluster" in self.integrator

    def _nested(self, name: str, parameter: str) -> mi.Properties:
        """Parameters of the integrator's child of that name or id."""
        children = self._named_children(self._integrator_node)
        for key, node in children:
            if name in (key, node.props.id()):
                return node.props
        if parameter != "shapes":
            there = ", ".join(node.props.id() or key for key, node in children)
            raise ValueError(
                f'"{name}.{parameter}": integrator "{self.integrator.plugin_name()}" holds no '
                f'"{name}", only {there or "parameters"}; set "{name}.shapes" too for a cluster of '
                "that name"
            )
        self._append_child(self._integrator_node, mi.ObjectType.Emitter, "mipmap_cube", name)
        return self._nested(name, parameter)

    @property
    def _integrator_node(self) -> mi.parser.SceneNode:
        return self._children(self._state.root, mi.ObjectType.Integrator)[0]

    def _children(
        self, parent: mi.parser.SceneNode, kind: mi.ObjectType
    ) -> list[mi.parser.SceneNode]:
        return [node for _, node in self._named_children(parent) if node.type == kind]

    def _named_children(self, parent: mi.parser.SceneNode) -> list[tuple[str, mi.parser.SceneNode]]:
        # A copy: Mitsuba takes what has been read for known, and would miss misspelt names.
        return [
            (name, self._state.nodes[value.index()])
            for name, value in mi.Properties(parent.props).items()
            if isinstance(value, mi.Properties.ResolvedReference)
        ]

    def _append_child(
        self, parent: mi.parser.SceneNode, kind: mi.ObjectType, plugin: str, name: str = ""
    ) -> None:
        # Link first: appending may move the nodes in memory, which invalidates `parent`.
        index = len(self._state.nodes)
        parent.props[name or f"_{plugin}"] = mi.Properties.ResolvedReference(index)
        node = mi.parser.SceneNode()
        node.type = kind
        node.props = mi.Properties(plugin)
        node.props.set_id(name)
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
