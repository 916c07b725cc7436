"""README.md, the docstrings and the code name the same parameters."""

from __future__ import annotations

import re
from collections import defaultdict
from xml.etree import ElementTree

import mitsuba as mi
import pytest

from envmap_integrator.system.parameters import Parameters
from tests.readme import README, documented, plugins, updated

pytestmark = pytest.mark.usefixtures("variant")

NAMES = ["envmap_hybrid", "one_level_path", "source_selection", "envmap_bake", "mipmap_cube"]
READERS = (
    *("integer", "power_of_two", "number", "flag", "choice"),
    *("text", "names", "point", "rotation"),
)
#: Uses of a plugin that read different parameters; those that aren't listed are loaded bare.
USES = {"mipmap_cube": [{"shapes": "ball"}, {"filename": "none.exr"}]}
#: Read by Mitsuba's base class of all integrators.
INHERITED = {"hide_emitters": False}


@pytest.fixture
def parameters_read(monkeypatch):
    """``parameters_read(plugin)``: name and default of all that a plugin asks for."""
    asked = defaultdict(dict)  # By plugin: integrators load others.

    def spy(reader):
        original = getattr(Parameters, reader)

        def ask(self, name, *limits):
            asked[self.owner.split()[0]][name] = limits[0] if limits else None
            return original(self, name, *limits)

        monkeypatch.setattr(Parameters, reader, ask)

    for reader in READERS:
        spy(reader)

    def read(plugin: str) -> dict[str, object]:
        for use in USES.get(plugin, [{}]):
            try:
                loaded = mi.load_dict({"type": plugin} | use)
            except RuntimeError as error:  # There is no map of that name.
                assert "none.exr: no such file" in str(error)
        inherited = INHERITED if isinstance(loaded, mi.Integrator) else {}
        return asked[plugin] | inherited

    return read


def test_all_plugins_are_covered():
    assert set(NAMES) == set(plugins())


@pytest.mark.parametrize("plugin", NAMES)
def test_docstrings_name_the_parameters_that_plugins_read(plugin, parameters_read):
    names = [parameter.name for parameter in documented(plugins()[plugin])]
    assert len(names) == len(set(names))
    assert set(names) == set(parameters_read(plugin))


@pytest.mark.parametrize("plugin", NAMES)
def test_documented_defaults_are_those_of_the_code(plugin, parameters_read):
    read = parameters_read(plugin)
    for parameter in documented(plugins()[plugin]):
        default = read[parameter.name]
        if default not in ("", None):  # Words say what happens without a value.
            assert parameter.default == _as_text(default), parameter.name


def _as_text(value: object) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value).lower()


@pytest.mark.parametrize("plugin", NAMES[:-1])
def test_all_integrators_take_the_inherited_parameters(plugin):
    assert mi.load_dict({"type": plugin, "hide_emitters": True}).hide_emitters


def test_readme_has_the_parameters_of_the_docstrings():
    text = README.read_text(encoding="utf-8")
    assert text == updated(text), "bring it up to date with: python -m tests.readme"


def test_xml_examples_load():
    blocks = re.findall(r"```xml\n(.*?)```", README.read_text(encoding="utf-8"), re.S)
    examples = [part for block in blocks for part in ElementTree.fromstring(f"<_>{block}</_>")]
    assert examples
    for example in examples:
        example.set("version", "3.0.0")
        assert isinstance(mi.load_string(ElementTree.tostring(example, "unicode")), mi.Integrator)


def test_files_that_the_readme_links_to_exist():
    text = README.read_text(encoding="utf-8")
    links = re.findall(r"\]\(([^)#:]+)\)", text)
    assert links
    assert [link for link in links if not (README.parent / link).exists()] == []
