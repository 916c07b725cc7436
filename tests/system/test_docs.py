"""The tutorial runs as it stands: its cells are executed in order, in one name space."""

from __future__ import annotations

import json
import re

import pytest

from envmap_integrator.registration import PLUGINS
from tests.api import page
from tests.helpers import ROOT
from tests.readme import plugins, table

pytestmark = pytest.mark.usefixtures("variant")

DOCS = ROOT / "envmap_integrator" / "docs"
PAGES = sorted(path for path in DOCS.iterdir() if path.suffix in (".md", ".ipynb"))


def cells(path, kind: str) -> list[str]:
    notebook = json.loads(path.read_text(encoding="utf-8"))
    return ["".join(cell["source"]) for cell in notebook["cells"] if cell["cell_type"] == kind]


def test_the_tutorial_runs(monkeypatch, capsys):
    path = DOCS / "tutorial.ipynb"
    monkeypatch.chdir(DOCS)
    names = {}
    for cell in cells(path, "code"):
        exec(compile(cell, path.name, "exec"), names)
    shown = capsys.readouterr().out
    assert "prepared anew: False" in shown and "prepared anew: True" in shown
    assert "96 samples per pixel" in shown
    assert "made for another scene: it has other emitters" in shown
    assert names["of_hybrid"] < names["of_path"] / 3


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.name)
def test_files_that_pages_link_to_exist(path):
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".ipynb":
        text = "\n".join(cells(path, "markdown"))
    links = re.findall(r"\]\(([^)#:]+)[^):]*\)", text)
    assert [link for link in links if not (DOCS / link).exists()] == []


@pytest.mark.parametrize("name", PLUGINS)
def test_pages_of_the_interface_have_the_parameters(name):
    """``pdoc`` knows nothing of the form in which Mitsuba's plugins list theirs."""
    plugin = plugins()[name]
    text = page(plugin)
    assert table(plugin) in text
    assert ":monosp:" not in text and "|int|" not in text
