"""``system.printed``: what is printed is found again, by names."""

from __future__ import annotations

import mitsuba as mi
import pytest

from envmap_integrator.system.printed import plain, printed
from tests.helpers import cluster, integrator

pytestmark = pytest.mark.usefixtures("variant")


def test_parameters_and_those_of_what_is_nested():
    ours = integrator("envmap_hybrid", baker={"type": "envmap_bake", "samples": 4}, desk=cluster())
    found = {name: plain(text) for name, text in printed(ours).items()}
    assert (found["baker.samples"], found["irradiance_filter"], found["mip_bias"]) == (4, False, -2)
    assert (found["sampler"], found["cache_file"], found["patch_samples"]) == ("scene", "", None)
    (request,) = found["requests"]
    assert request["name"] == "desk" and "block" in request["shapes"]


def test_objects_of_mitsuba():
    child = {"type": "path", "max_depth": 3}
    found = printed(mi.load_dict({"type": "aov", "aovs": "d:depth", "child": child}))
    assert found["integrators.PathIntegrator.max_depth"] == "3"
    film = mi.load_dict({"type": "hdrfilm", "width": 4, "height": 5})
    assert plain(printed(film)["size"]) == [4, 5] and printed(film)["pixel_format"] == "rgb"


def test_objects_in_a_list_are_all_there():
    mi.set_variant("llvm_ad_spectral")
    bands = {
        name: {"type": "spectrum", "value": [(500, 1.0), (last, 1.0)]}
        for name, last in (("a", 600), ("b", 650))
    }
    found = printed(mi.load_dict({"type": "specfilm"} | bands))
    assert "[500, 600], [500, 650]" in found.values() and found["size"] == "[768, 576]"
