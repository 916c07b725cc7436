"""The variants that are supported agree with ``path``; the others are told so."""

from __future__ import annotations

import subprocess
import sys

import pytest

from tests.helpers import ROOT

SWITCH = """
import envmap_integrator
import mitsuba as mi
from tests.helpers import assert_agree, integrator, load, measure, room
for variant in ("llvm_ad_rgb", "llvm_ad_mono", "llvm_ad_spectral", "llvm_ad_rgb"):
    mi.set_variant(variant)
    scene = load(room())
    ours, path = (
        measure(scene, one, spp=256)
        for one in (integrator("envmap_hybrid", irradiance_filter=True), integrator("path"))
    )
    assert_agree(ours.overall(), path.overall(), allowed=0.02, precision=0.02)
"""
IMPORT_LATE = """
import mitsuba as mi
mi.set_variant("llvm_ad_rgb")
import envmap_integrator
mi.load_dict({"type": "envmap_hybrid"})
"""
LOAD = """
import envmap_integrator
import mitsuba as mi
mi.set_variant("{variant}")
try:
    mi.load_dict({{"type": "{plugin}"}})
except RuntimeError as error:
    print(error)
"""


def python(code: str) -> str:
    """What a program prints in a process of its own."""
    result = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    return result.stdout


def test_variants_can_be_switched():
    python(SWITCH)


def test_the_package_may_be_imported_after_the_variant_is_set():
    python(IMPORT_LATE)


@pytest.mark.parametrize(
    "variant", ["scalar_rgb", "llvm_ad_spectral_polarized", "llvm_ad_mono_polarized"]
)
@pytest.mark.parametrize("plugin", ["envmap_hybrid", "one_level_path"])
def test_other_variants_get_a_clear_error(variant, plugin):
    message = python(LOAD.format(variant=variant, plugin=plugin))
    assert f"variant {variant} isn't supported; use one of llvm_ad_rgb" in message
