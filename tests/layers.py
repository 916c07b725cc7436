"""Which folders of the package import which, read from its source.

``python -m tests.layers`` prints the picture that the package's README.md shows.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from graphlib import TopologicalSorter
from pathlib import Path

from tests.helpers import ROOT

PACKAGE = ROOT / "envmap_integrator"

Graph = dict[str, set[str]]


def module_imports() -> Graph:
    """The modules of the package that each module imports, by dotted names below the package.

    Raises ``FileNotFoundError`` for an import of a module that isn't there.
    """
    files = (path for path in PACKAGE.rglob("*.py") if path.name != "__init__.py")
    return {_name(path): set(_imported(path)) for path in files}


def folder_imports(modules: Graph) -> Graph:
    """The same by the folders that modules lie in; those of the package itself are left out."""
    folders: Graph = {}
    for module, imported in modules.items():
        folder = _folder(module)
        if folder:
            others = {_folder(other) for other in imported} - {folder, ""}
            folders.setdefault(folder, set()).update(others)
    return folders


def order(graph: Graph) -> list[str]:
    """What is imported before what imports it; raises ``graphlib.CycleError`` for circles."""
    return list(TopologicalSorter(graph).static_order())


def picture(folders: Graph) -> str:
    """A Mermaid flowchart; imports that follow from others aren't drawn."""
    lines = ["```mermaid", "flowchart TD"]
    for folder in reversed(order(folders)):
        for other in sorted(folders[folder]):
            between = folders[folder] - {other}
            if not any(other in _reach(folders, step) for step in between):
                lines.append(f"    {folder} --> {other}")
    return "\n".join([*lines, "```"])


def _reach(graph: Graph, start: str) -> set[str]:
    """All that can be come to from a node."""
    reached: set[str] = set()
    pending = [start]
    while pending:
        new = graph[pending.pop()] - reached
        reached |= new
        pending += new
    return reached


def _name(path: Path) -> str:
    return ".".join(path.relative_to(PACKAGE).with_suffix("").parts)


def _folder(module: str) -> str:
    return module.rpartition(".")[0].replace(".", "/")


def _imported(path: Path) -> Iterator[str]:
    here = ("envmap_integrator", *path.relative_to(PACKAGE).parent.parts)
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if not isinstance(node, ast.ImportFrom):
            continue
        base = here[: len(here) + 1 - node.level] if node.level else ()
        parts = (*base, *(node.module.split(".") if node.module else ()))
        if parts[:1] != ("envmap_integrator",):
            continue
        target = PACKAGE.joinpath(*parts[1:])
        if target.with_suffix(".py").exists():
            yield _name(target.with_suffix(".py"))
        else:  # Modules of a folder.
            for alias in node.names:
                module = target / f"{alias.name}.py"
                if not module.exists():
                    raise FileNotFoundError(f"{path}: imports {module}, which isn't there")
                yield _name(module)


if __name__ == "__main__":
    print(picture(folder_imports(module_imports())))
