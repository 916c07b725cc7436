"""Speed-ups read off curves that are known in closed form."""

from __future__ import annotations

import numpy as np
import pytest

from compare.curves import Curve, overtaking_time, speed_up

SPP = [1, 4, 16, 64]
RUNS = 3


def curve(variance=1.0, seconds=1.0, prepare_s=0.0, floor=0.0, jitter=0.0) -> Curve:
    """An integrator of ``variance / spp + floor`` that takes ``seconds`` a sample."""
    spp = np.array(SPP)[:, None] * np.ones(RUNS)
    factor = 1 + jitter * np.array([-1, 0, 1])
    return Curve(
        name="known",
        spp=SPP,
        errors=variance / spp + floor,
        seconds=(prepare_s + seconds * spp) * factor,
        prepare_s=np.full_like(spp, prepare_s) * factor,
        floor=floor,
        tiled_floor=floor,
    )


@pytest.mark.parametrize("error", [0.7, 0.2, 0.05])
def test_against_itself(error):
    measured = speed_up(curve(), curve(), error)
    assert measured.value == pytest.approx(1) and not measured.extrapolated


@pytest.mark.parametrize("error", [0.2, 0.05, 0.02])
def test_less_variance_and_less_time_multiply(error):
    fast = curve(variance=0.25, seconds=0.5)
    assert speed_up(curve(), fast, error).value == pytest.approx(8)


def test_the_slow_one_is_extrapolated():
    measured = speed_up(curve(), curve(variance=0.1), 0.005)
    assert measured.value == pytest.approx(10) and measured.extrapolated


def test_one_sample_is_the_least_there_is():
    assert speed_up(curve(), curve(variance=0.01), 0.5).value == pytest.approx(2)


def test_preparation_counts():
    # 16 samples each: 16 s against 16 s + 16 s.
    assert speed_up(curve(), curve(prepare_s=16), 1 / 16).value == pytest.approx(0.5)


def test_below_the_floor_there_is_no_speed_up():
    assert speed_up(curve(), curve(floor=0.1), 0.05) is None


def test_the_fast_one_is_never_extrapolated():
    assert speed_up(curve(), curve(), 0.001) is None


def test_a_slow_one_with_a_floor_is_not_extrapolated():
    assert speed_up(curve(floor=0.1), curve(), 0.05) is None


def test_margin_covers_the_spread_of_the_runs():
    measured = speed_up(curve(), curve(jitter=0.1), 0.2)
    assert measured.value == pytest.approx(1, rel=0.02)
    assert 0.1 < measured.margin < 0.5


def test_path_overtakes_where_the_floor_is():
    # 1/t falls below 0.1/t + 0.01 at t = 90.
    overtaking = overtaking_time(curve(), curve(variance=0.1, floor=0.01))
    assert overtaking.seconds == pytest.approx(90, rel=0.02)
    assert "extrapolated" in overtaking.text


def test_an_unbiased_faster_one_is_never_overtaken():
    assert overtaking_time(curve(), curve(variance=0.5)).seconds is None


def test_a_slower_one_is_never_ahead():
    assert overtaking_time(curve(), curve(variance=2)).seconds == 0
