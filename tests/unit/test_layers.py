"""Imports go one way, from folder to folder and from module to module."""

from __future__ import annotations

import subprocess
import sys

from tests.helpers import ROOT
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


def test_modules_can_be_imported_before_a_variant_is_chosen():
    """But for plugins, whose base classes differ between variants."""
    names = (name for name in module_imports() if not name.startswith(("integrators", "emitters")))
    program = "\n".join(f"import envmap_integrator.{name}" for name in names)
    subprocess.run([sys.executable, "-c", program], cwd=ROOT, check=True)
