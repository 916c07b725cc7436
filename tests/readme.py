"""The parameter tables of README.md, made from the docstrings of the plugins.

``python -m tests.readme`` brings the README up to date.
"""

from __future__ import annotations

import importlib
import re
from dataclasses import dataclass

import mitsuba as mi

from envmap_integrator.registration import PLUGINS
from tests.helpers import ROOT

README = ROOT / "README.md"

#: XML elements of the types that docstrings name, where they have another name.
ELEMENTS = {"int": "integer", "float": "float", "bool": "boolean"}

_PARAMETER = re.compile(r"^ \* - (\w+)\n +- \|(\w+)\|\n +- (.*?)(?=^ \* - |\Z)", re.M | re.S)
_DEFAULT = re.compile(r" ?\(Default: (.*)\)$")


@dataclass(frozen=True)
class Parameter:
    """A parameter as its plugin's docstring has it; ``default`` is empty where there is none."""

    name: str
    element: str
    default: str
    meaning: str


def plugins() -> dict[str, type]:
    """The classes of all plugins by their names, for the active variant."""
    return {
        name: getattr(importlib.import_module(f"envmap_integrator.{module}"), class_name)
        for name, (module, class_name) in PLUGINS.items()
    }


def documented(plugin: type) -> list[Parameter]:
    """What the ``pluginparameters`` block of a docstring lists."""
    _, _, text = plugin.__doc__.partition(".. pluginparameters::")
    block = re.match(r"(?:\n|     .*\n)*", text)[0]
    block = re.sub(r"^    ", "", block, flags=re.M)
    return [
        _parameter(name, kind, " ".join(words.split()))
        for name, kind, words in _PARAMETER.findall(block)
    ]


def _parameter(name: str, kind: str, words: str) -> Parameter:
    default = _DEFAULT.search(words)
    meaning = words[: default.start()] if default else words
    return Parameter(
        name, ELEMENTS.get(kind, kind), default[1] if default else "", _markdown(meaning)
    )


def _markdown(text: str) -> str:
    return re.sub(r":\w+:`([^`]*)`|``([^`]*)``", lambda m: f"`{m[1] or m[2]}`", text)


def table(plugin: type, known: type | None = None) -> str:
    """The parameters of a plugin in Markdown; of those that are ``known``, the names alone."""
    elsewhere = documented(known) if known else []
    own = [p for p in documented(plugin) if p not in elsewhere]
    shared = [f"`{p.name}`" for p in documented(plugin) if p in elsewhere]
    lines = ["| parameter | type | default | meaning |", "|---|---|---|---|"] if own else []
    lines += [f"| `{p.name}` | {p.element} | {p.default} | {p.meaning} |" for p in own]
    if shared:
        lines += (
            ["", f"As above: {', '.join(shared)}."] if own else [f"As above: {', '.join(shared)}."]
        )
    return "\n".join(lines)


def updated(readme: str) -> str:
    """The text of the README with every plugin's table between its two markers."""
    found = plugins()
    for name, plugin in found.items():
        begin, end = f"<!-- parameters of {name} -->\n", "<!-- end -->"
        head, marker, rest = readme.partition(begin)
        if not marker:
            raise ValueError(f'README.md has no line "{begin.strip()}"')
        readme = (
            head + begin + table(plugin, _known(found, plugin)) + "\n" + rest[rest.index(end) :]
        )
    return readme


def _known(found: dict[str, type], plugin: type) -> type | None:
    """What has been listed above a plugin."""
    first = found["envmap_hybrid"]
    return None if plugin is first else first


if __name__ == "__main__":
    mi.set_variant("llvm_ad_rgb")
    README.write_text(updated(README.read_text(encoding="utf-8")), encoding="utf-8")
