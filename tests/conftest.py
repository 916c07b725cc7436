"""Fixtures for all tests: the variant, a clean Dr.Jit after each, pictures of failures."""

from __future__ import annotations

import gc
import os
import re
import signal
import tempfile
from pathlib import Path

import envmap_integrator  # noqa: F401  (before mitsuba: it chooses libLLVM)

# isort: split
import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

TESTS = Path(__file__).parent
ARTEFACTS = TESTS / "artefacts"
LAYERS = {
    "unit": "one module, without a render",
    "system": "the plugins and the command line, end to end",
    "regression": "pictures and figures against stored or reference ones",
    "fuzz": "random scenes",
}
DEFAULT_VARIANT = "llvm_ad_rgb"
#: Folder of third-party scenes, each in a folder of its own: too large to keep here.
THIRD_PARTY = "ENVMAP_THIRD_PARTY_SCENES"


def pytest_configure(config):
    for layer, meaning in LAYERS.items():
        config.addinivalue_line("markers", f"{layer}: {meaning} (set by the folder)")
    config.addinivalue_line("markers", "variants(*names): run once in each Mitsuba variant")
    # Shells start jobs in the background deaf to Ctrl-C, and their children inherit that.
    signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_collection_modifyitems(items):
    for item in items:
        layer = item.path.relative_to(TESTS).parts[0]
        if layer in LAYERS:
            item.add_marker(layer)


def pytest_collection_finish():
    gc.freeze()  # What is imported stays: collecting garbage after each test is cheap.


# ---------------------- Variants ----------------------


@pytest.fixture(scope="module")
def variant(request) -> str:
    """The active variant: ``llvm_ad_rgb``, or each one of ``@pytest.mark.variants(...)``."""
    name = getattr(request, "param", DEFAULT_VARIANT)
    mi.set_variant(name)
    return name


def pytest_generate_tests(metafunc):
    marker = metafunc.definition.get_closest_marker("variants")
    if marker:
        metafunc.parametrize("variant", marker.args, indirect=True, scope="module")


@pytest.fixture(autouse=True)
def clean_drjit():
    """Leave the next test the variant of the last one, no garbage, and no memory held back."""
    before = mi.variant()
    yield
    if before is not None and mi.variant() != before:
        mi.set_variant(before)
    gc.collect()
    dr.sync_thread()
    dr.flush_malloc_cache()


# ---------------------- Files ----------------------


@pytest.fixture
def public_folder():
    """A folder like ``tmp_path``, but others can come to it."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        folder.chmod(0o755)
        yield folder


# ---------------------- Pictures ----------------------


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item, call):
    report = yield
    if call.when == "call":
        item.stash[_FAILED] = report.failed
    return report


_FAILED = pytest.StashKey[bool]()


@pytest.fixture
def artefacts(request):
    """Pictures to look at if the test fails: ``artefacts["ours"] = image``.

    They go to ``tests/artefacts`` as EXR and PNG, named after the test.
    """
    pictures: dict[str, np.ndarray] = {}
    yield pictures
    if not request.node.stash.get(_FAILED, False):
        return
    ARTEFACTS.mkdir(exist_ok=True)
    test = re.sub(r"[^\w-]+", "-", request.node.name).strip("-")
    for name, picture in pictures.items():
        for suffix in ("exr", "png"):
            path = ARTEFACTS / f"{test}-{name}.{suffix}"
            # Mitsuba waits for ever for the second of two files that are written in the background.
            bitmap = mi.TensorXf(np.asarray(picture, np.float32))
            mi.util.write_bitmap(str(path), bitmap, write_async=False)


# ---------------------- Third-party scenes ----------------------


@pytest.fixture
def third_party_scene():
    """``third_party_scene("veach-ajar")``: the path of its scene file; skips where it's absent."""

    def find(name: str) -> Path:
        folder = os.environ.get(THIRD_PARTY)
        if not folder:
            pytest.skip(f"{THIRD_PARTY} isn't set")
        found = sorted((Path(folder) / name).glob("scene*.xml"))
        if not found:
            pytest.skip(f'{THIRD_PARTY} holds no scene "{name}"')
        return found[0]

    return find
