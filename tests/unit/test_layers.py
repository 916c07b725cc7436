"""Imports go one way, from folder to folder and from module to module."""

from __future__ import annotations

from tests.layers import PACKAGE, folder_imports, module_imports, order, picture


def test_imports_of_modules_and_folders_have_no_circles():
    modules = module_imports()
    order(modules)
    folders = order(folder_imports(modules))

    roles = ["system", "lookup", "transport", "preparation", "integrators"]
    assert [folder for folder in folders if folder in roles] == roles


def test_readme_shows_imports():
    assert picture(folder_imports(module_imports())) in (PACKAGE / "README.md").read_text(
        encoding="utf-8"
    )
