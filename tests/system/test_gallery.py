"""The hard cases of ``compare``, each by every integrator, and whether problems are found."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from compare.gallery import INTEGRATORS, judge, reference
from compare.hard_cases import CASES

pytestmark = pytest.mark.usefixtures("variant")


@pytest.fixture(scope="module", autouse=True)
def forget_the_last_scene():
    yield
    reference.cache_clear()


# The integrators of a case follow each other: they share the scene and the reference.
@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("case", CASES)
def test_case(case, integrator, artefacts):
    verdict = judge(CASES[case], integrator)
    if verdict.picture is not None:
        artefacts["ours"] = verdict.picture
        artefacts["path"] = reference(CASES[case])[1].mean(axis=0)
    assert verdict.problems == ()


def test_every_picture_has_a_bound():
    unbounded = [name for name, case in CASES.items() if not math.isfinite(case.brightest)]
    assert unbounded == [name for name, case in CASES.items() if case.error]


# ---------------------- The judge ----------------------


def problems(case: str, **changes) -> str:
    return " ".join(judge(replace(CASES[case], **changes), "envmap_hybrid").problems)


def test_a_pixel_that_is_too_bright_is_found():
    assert "0.1 is possible" in problems("a lamp beyond a cube", brightest=0.1)


def test_a_mean_that_is_off_is_found():
    assert "mean off by -" in problems("a constant sky", own={"hide_emitters": True})


def test_noise_that_hides_errors_is_found():
    assert "too noisy" in problems("a lamp beyond a cube", spp=1, precision=0.001)


def test_warnings_are_found():
    assert "its cube holds the whole scene" in problems("a cube larger than the scene", warnings=0)


def test_a_missing_error_is_found():
    assert "no error" in problems("a lamp beyond a cube", error="the scene has no emitters")


def test_another_error_is_found():
    assert 'expected "too dark"' in problems("no emitters", error="too dark")
