"""Error against time, and what is read off such curves."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from compare.metrics import Estimate

NO_FLOOR = 0.05
"""A floor below this share of the last error is lost in its noise."""


@dataclass(frozen=True)
class Curve:
    """Errors and times of one integrator over ascending sample counts.

    spp          samples per pixel [S]
    errors       relMSE [S, runs]
    seconds      wall time with preparation [S, runs]
    prepare_s    of which preparation took [S, runs]
    floor        relMSE that is left without noise
    tiled_floor  the same, of averages over tiles of pixels
    """

    name: str
    spp: list[int]
    errors: NDArray[np.float64]
    seconds: NDArray[np.float64]
    prepare_s: NDArray[np.float64]
    floor: float
    tiled_floor: float

    def time_to(self, error: float, run: int) -> tuple[float, bool]:
        """Seconds until one run has this error, and whether that is extrapolated.

        Between two sample counts, error and time are interpolated as power laws. Before the first,
        its time counts: fewer samples than one there aren't. After the last, an error without a
        floor falls as 1/spp; for one with a floor the time is NaN.
        """
        errors = np.minimum.accumulate(np.maximum(self.errors[:, run], 1e-30))
        seconds = self.seconds[:, run]
        if error >= errors[0]:
            return float(seconds[0]), False
        if error < errors[-1]:
            unbiased = self.floor < NO_FLOOR * errors[-1]
            factor = errors[-1] / error if unbiased else np.nan
            prepare_s = self.prepare_s[-1, run]
            return float(prepare_s + (seconds[-1] - prepare_s) * factor), True
        order = np.argsort(errors, kind="stable")
        return float(
            np.exp(np.interp(np.log(error), np.log(errors[order]), np.log(seconds[order])))
        ), False

    def numbers(self) -> dict[str, object]:
        """For the JSON file."""
        return vars(self)


@dataclass(frozen=True)
class SpeedUp(Estimate):
    """Ratio of times at equal error; ``extrapolated`` if the slower one was."""

    extrapolated: bool


def speed_up(slow: Curve, fast: Curve, error: float) -> SpeedUp | None:
    """How many times as fast ``fast`` reaches the error; None if it or the error is out of reach.

    One ratio a run: runs take turns, so those of one index have seen the same machine. The margin
    is that of a 95 % interval of their geometric mean.
    """
    if not error > 0:
        return None
    runs = range(fast.errors.shape[1])
    ours = [fast.time_to(error, run) for run in runs]
    theirs = [slow.time_to(error, run) for run in runs]
    if any(extrapolated for _, extrapolated in ours):
        return None
    logs = np.log([t[0] / o[0] for t, o in zip(theirs, ours, strict=True)])
    if not np.all(np.isfinite(logs)):
        return None
    value = float(np.exp(logs.mean()))
    margin = stats.t.ppf(0.975, len(logs) - 1) * stats.sem(logs) if len(logs) > 1 else np.inf
    return SpeedUp(value, float(value * margin), any(extrapolated for _, extrapolated in theirs))


@dataclass(frozen=True)
class Overtaking:
    """From when on ``slow`` has the smaller error; None: never, as far as is known."""

    seconds: float | None
    error: float | None
    text: str


def overtaking_time(slow: Curve, fast: Curve) -> Overtaking:
    """Where the mean error of ``slow``, falling as 1/spp past its last point, meets ``fast``'s.

    Past its last point ``fast`` is taken to go on falling as 1/spp towards its floor.
    """
    times = np.geomspace(slow.seconds.min() / 2, 1e4 * slow.seconds.max(), 4000)
    ours, theirs = _mean_error(fast, times), _mean_error(slow, times)
    ahead = ours < theirs
    if not ahead.any():
        return Overtaking(0.0, None, "always ahead")
    last = np.flatnonzero(ahead)[-1]
    if last == len(times) - 1:
        return Overtaking(None, None, "never")
    at, error = float(times[last]), float(theirs[last])
    beyond = ", extrapolated" if at > min(np.median(c.seconds[-1]) for c in (slow, fast)) else ""
    return Overtaking(at, error, f"{at:.3g} s, {error:.1e}{beyond}")


def _mean_error(curve: Curve, times: NDArray[np.float64]) -> NDArray[np.float64]:
    """Mean relMSE after so many seconds, infinite before the first picture is there."""
    seconds, errors = np.median(curve.seconds, axis=1), curve.errors.mean(axis=1)
    errors = np.maximum(errors, 1e-30)
    within = np.exp(np.interp(np.log(times), np.log(seconds), np.log(errors)))
    floor = min(max(curve.floor, 0), errors[-1])
    prepare_s = np.median(curve.prepare_s[-1])
    rendered = (times - prepare_s) / (seconds[-1] - prepare_s)
    after = floor + (errors[-1] - floor) / np.maximum(rendered, 1)
    return np.where(times < seconds[0], np.inf, np.where(times > seconds[-1], after, within))
