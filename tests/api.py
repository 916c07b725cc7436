"""Pages of the interface, from the docstrings: ``python -m tests.api FOLDER``, by ``pdoc``."""

from __future__ import annotations

import inspect
import re
import sys
from pathlib import Path

import mitsuba as mi

from tests.readme import plugins, table

VARIANT = "llvm_ad_rgb"


def page(plugin: type) -> str:
    """A plugin's docstring in Markdown: of Mitsuba's form, its text and its parameters."""
    text, _, _ = inspect.cleandoc(plugin.__doc__).partition(".. pluginparameters::")
    return re.sub(r":\w+:`([^`]*)`", r"`\1`", text) + table(plugin)


def write(folder: Path) -> None:
    """Write the pages of all modules; plugins exist once there is a variant."""
    import pdoc

    mi.set_variant(VARIANT)
    for plugin in plugins().values():
        plugin.__doc__ = page(plugin)
    pdoc.pdoc("envmap_integrator", output_directory=folder)


if __name__ == "__main__":
    write(Path(sys.argv[1]))
