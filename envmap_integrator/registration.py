"""Registers the plugins with Mitsuba, anew for every variant."""

from __future__ import annotations

import importlib
import re
import sys
from difflib import get_close_matches
from functools import partial

import mitsuba as mi

#: Plugin modules in the order of their imports of each other; common bases first.
_MODULES = (
    "integrators.base",
    "integrators.one_level_path",
    "integrators.source_selection",
    "integrators.envmap_bake",
    "emitters.mipmap_cube",
    "integrators.envmap_hybrid",
)
PLUGINS = {
    "one_level_path": ("integrators.one_level_path", "OneLevelPath"),
    "source_selection": ("integrators.source_selection", "SourceSelection"),
    "envmap_bake": ("integrators.envmap_bake", "EnvmapBake"),
    "envmap_hybrid": ("integrators.envmap_hybrid", "EnvmapHybrid"),
    "mipmap_cube": ("emitters.mipmap_cube", "MipmapCube"),
}
_EMITTERS = ("mipmap_cube",)
#: A parameter's name in the documentation of a plugin.
_PARAMETER = re.compile(r"^ +\* - (\w+)$", re.MULTILINE)


def register() -> None:
    """Register all plugins for the active variant, and for those chosen later."""
    mi.detail.add_variant_callback(_variant_changed)
    if mi.variant() is not None:
        _register()


def _variant_changed(old: str | None, new: str | None) -> None:
    if new is not None and new != old:
        _register()


def _register() -> None:
    # Mitsuba's base classes differ between variants: class bodies have to be executed again.
    for name in _MODULES:
        full_name = f"{__package__}.{name}"
        if full_name in sys.modules:
            importlib.reload(sys.modules[full_name])
        else:
            importlib.import_module(full_name)
    for plugin, (module, name) in PLUGINS.items():
        register_plugin = mi.register_emitter if plugin in _EMITTERS else mi.register_integrator
        kind = getattr(sys.modules[f"{__package__}.{module}"], name)
        register_plugin(plugin, partial(_make, kind))


def _make(kind: type, props: mi.Properties) -> mi.Object:
    """A plugin; ``ValueError`` for a parameter that it hasn't read, with names that are near.

    Mitsuba would refuse that, too, but without knowing the others.
    """
    made = kind(props)
    for name in props.unqueried():
        near = get_close_matches(name, _PARAMETER.findall(kind.__doc__ or ""))
        mend = "".join(f'write "{each}" or ' for each in near) + "remove it"
        raise ValueError(f'{props.plugin_name()}: there is no parameter "{name}"; {mend}')
    return made
