"""Checks that stop with one line where we can't render right, instead of rendering wrong."""

from __future__ import annotations

import mitsuba as mi

from .llvm import ensure_llvm

SUPPORTED_VARIANTS = ("llvm_ad_rgb", "llvm_ad_mono", "cuda_ad_rgb", "cuda_ad_mono")


def check_variant(plugin: str) -> None:
    """Raise ``RuntimeError`` if the active variant can't run the plugin."""
    variant = mi.variant()
    if variant not in SUPPORTED_VARIANTS:
        raise RuntimeError(
            f"{plugin}: variant {variant} isn't supported; use one of "
            f"{', '.join(SUPPORTED_VARIANTS)}"
        )
    if variant.startswith("llvm"):
        ensure_llvm()


def check_scene(scene: mi.Scene, owner: str) -> None:
    """Raise ``ValueError`` for scenes without surfaces or emitters, and with participating media."""
    shapes = scene.shapes()
    if not shapes:
        raise ValueError(f"{owner}: the scene has no surfaces; add a shape")
    if not scene.emitters():
        raise ValueError(f"{owner}: the scene has no emitters, all would be black; add one")
    for shape in shapes:
        for name in ("interior_medium", "exterior_medium"):
            medium = getattr(shape, name)()
            if medium is not None:
                raise ValueError(
                    f'{owner}: shape "{shape.id()}" has participating media ("{medium.id()}" as '
                    f'"{name}"), which aren\'t supported; remove it or use volpath'
                )
    for sensor in scene.sensors():
        if sensor.get_medium() is not None:
            raise ValueError(
                f'{owner}: sensor "{sensor.id()}" lies in a medium, which isn\'t supported; '
                "remove it or use volpath"
            )
