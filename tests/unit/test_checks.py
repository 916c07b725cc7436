"""Scenes and variants that can't be rendered right are refused in one line."""

from __future__ import annotations

import mitsuba as mi
import pytest

from envmap_integrator.system.checks import SUPPORTED_VARIANTS, check_scene, check_variant
from tests.helpers import ball, camera, load, room

pytestmark = pytest.mark.usefixtures("variant")


def fog(albedo: float) -> dict:
    return {"type": "homogeneous", "albedo": {"type": "rgb", "value": albedo}}


def smoky(albedo: float) -> dict:
    """A ball filled with smoke."""
    return ball(0, 0, 0, 0.3) | {"interior": fog(albedo), "bsdf": {"type": "null"}}


@pytest.mark.parametrize("absorbing", [{}, {"smoke": lambda: smoky(0.0)}])
def test_good_scenes_pass(absorbing):
    check_scene(load(room(**{name: part() for name, part in absorbing.items()})), "ours")


@pytest.mark.parametrize(
    ("description", "message"),
    [
        (lambda: {"type": "scene", "sky": {"type": "constant"}}, "has no surfaces; add a shape"),
        (lambda: room(lamp=None), "has no emitters, .*; add one"),
        (lambda: room(smoke=smoky(0.5)), '"smoke" has a participating medium .* remove it'),
        (lambda: room(sensor=camera(medium=fog(0.5))), "lies in a participating medium"),
    ],
)
def test_bad_scenes_are_refused_with_a_mend(description, message):
    with pytest.raises(ValueError, match=f"^ours: .*{message}") as caught:
        check_scene(load(description()), "ours")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", SUPPORTED_VARIANTS)
def test_supported_variants_pass(monkeypatch, name):
    monkeypatch.setattr(mi, "variant", lambda: name)
    check_variant("envmap_hybrid")


@pytest.mark.parametrize(
    "name", ["scalar_rgb", "llvm_ad_spectral_polarized", "llvm_ad_mono_polarized"]
)
def test_other_variants_are_refused(monkeypatch, name):
    monkeypatch.setattr(mi, "variant", lambda: name)
    with pytest.raises(RuntimeError, match=f"^envmap_hybrid: variant {name} .* llvm_ad_rgb"):
        check_variant("envmap_hybrid")


@pytest.mark.parametrize("name", ["scalar_rgb", "llvm_ad_spectral_polarized"])
@pytest.mark.parametrize(
    "plugin",
    ["envmap_hybrid", "one_level_path", "source_selection", "envmap_bake", "mipmap_cube"],
)
def test_plugins_refuse_them_when_they_are_loaded(name, plugin):
    mi.set_variant(name)
    with pytest.raises(RuntimeError, match=f"variant {name} isn't supported"):
        mi.load_dict({"type": plugin})
