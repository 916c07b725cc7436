"""Checks that stop with one line where we can't render right, instead of rendering wrong."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from .llvm import ensure_llvm

SUPPORTED_VARIANTS = tuple(
    f"{backend}_ad_{colour}"
    for backend in ("llvm", "cuda")
    for colour in ("rgb", "mono", "spectral")
)


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


def check_not_frozen(plugin: str) -> None:
    """Raise ``RuntimeError`` while ``dr.freeze`` records: it can't record what runs on the host."""
    if dr.flag(dr.JitFlag.FreezingScope):
        raise RuntimeError(
            f"{plugin}: can't be recorded by dr.freeze; render outside of the frozen function, or "
            "use path"
        )


def check_scene(scene: mi.Scene, owner: str) -> None:
    """Stop at scenes that would render black or wrong.

    Raises ``ValueError`` for scenes without surfaces or emitters, for emitters that only list a
    cluster, for meshes without faces, which Mitsuba's kernels can't read, and for participating
    media.
    Media that only absorb, as in tinted glass, are ignored with a warning: ``path``, the reference,
    ignores all media.
    """
    if not scene.shapes():
        raise ValueError(f"{owner}: the scene has no surfaces; add a shape")
    if not scene.emitters():
        raise ValueError(f"{owner}: the scene has no emitters, all would be black; add one")
    for emitter in scene.emitters():
        if getattr(emitter, "request", None) is not None:
            raise ValueError(f"{owner}: {misplaced(emitter)}")
    for shape in scene.shapes():
        if isinstance(shape, mi.Mesh) and shape.face_count() == 0:
            raise ValueError(f'{owner}: shape "{shape.id()}" is a mesh without faces; remove it')
        for name in ("interior", "exterior"):
            medium = getattr(shape, f"{name}_medium")()
            if medium is None:
                continue
            if _scatters(medium):
                raise ValueError(
                    f'{owner}: shape "{shape.id()}" has a participating medium '
                    f'({medium.class_name()} as "{name}"), which isn\'t supported; remove it or '
                    "use volpath"
                )
            mi.Log(
                mi.LogLevel.Warn,
                f'{owner}: the absorbing medium ("{name}") of shape "{shape.id()}" is ignored, '
                "as path does; use volpath to see it",
            )
    for sensor in scene.sensors():
        if sensor.get_medium() is not None:
            raise ValueError(
                f'{owner}: sensor "{sensor.id()}" lies in a participating medium, which isn\'t '
                "supported; remove it or use volpath"
            )


def sensor_of(scene: mi.Scene, sensor: mi.Sensor | int) -> mi.Sensor:
    """A sensor as it is, or that of an index in the scene; ``ValueError`` if there is none such."""
    if isinstance(sensor, mi.Sensor):
        return sensor
    sensors = scene.sensors()
    if not sensors:
        raise ValueError("the scene has no sensor; add one")
    if not 0 <= sensor < len(sensors):
        raise ValueError(
            f"there is no sensor {sensor} (-s/--sensor): the scene has {len(sensors)}; count from 0"
        )
    return sensors[sensor]


def check_size(sensor: mi.Sensor, spp: int) -> None:
    """Raise ``ValueError`` for pictures without pixels or samples; 0 ``spp`` are the sampler's."""
    width, height = (int(n) for n in sensor.film().crop_size())
    if not width * height:
        raise ValueError(
            f'the film of sensor "{sensor.id()}" has no pixels, but {width} x {height}; set its '
            '"width" and "height" to 1 or more'
        )
    samples = spp or sensor.sampler().sample_count()
    if samples < 1:
        raise ValueError(
            f'the sampler of sensor "{sensor.id()}" is to take {samples} samples per pixel; set '
            'its "sample_count" to 1 or more, or ask for so many'
        )


def check_film(sensor: mi.Sensor, owner: str) -> None:
    """Raise ``ValueError`` for films with bands beyond the wavelengths that are stored."""
    response = sensor.film().sensor_response_function()
    if response is None:
        return
    shortest, longest = response.wavelength_range()
    if shortest < mi.MI_CIE_MIN or longest > mi.MI_CIE_MAX:
        raise ValueError(
            f'{owner}: the film of sensor "{sensor.id()}" has bands from {shortest:g} nm to '
            f"{longest:g} nm, light is known from {mi.MI_CIE_MIN:g} nm to {mi.MI_CIE_MAX:g} nm; "
            "narrow the bands"
        )


def misplaced(emitter: mi.Emitter) -> str:
    """What to do about a ``mipmap_cube`` that lights a scene but has no map."""
    return (
        f'mipmap_cube "{emitter.id()}" lists "shapes" and emits nothing; put it inside the '
        'integrator envmap_hybrid, or give it a "filename"'
    )


def _scatters(medium: mi.Medium) -> bool:
    """Whether the single scattering albedo may be above zero anywhere."""
    albedos = [value for key, value in mi.traverse(medium) if key.startswith("albedo")]
    return not albedos or any(dr.max(dr.ravel(value))[0] > 0 for value in albedos)
