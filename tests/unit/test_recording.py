"""What is recorded is launched again for other data, and for nothing else."""

from __future__ import annotations

import os
import signal
import threading
import time
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import pytest

from envmap_integrator.system.interrupt import interruptible, memory, not_interrupted
from envmap_integrator.system.ray_counts import count_rays
from envmap_integrator.system.recording import MOST_KEYS, Recorder

pytestmark = pytest.mark.usefixtures("variant")


@dataclass(frozen=True)
class Line:
    slope: mi.Float
    steps: int


calls = []


def sum_of(line: Line, x: mi.Float) -> mi.Float:
    """What a kernel and a host compute together."""
    calls.append(line)
    return line.slope * x + line.steps


def of(*values: float) -> mi.Float:
    return dr.opaque(mi.Float, values[0]) if len(values) == 1 else mi.Float(values)


def test_other_data_are_launched_and_nothing_is_recorded():
    recorder = Recorder()
    calls.clear()
    for slope in (1, 2, 3):
        found = recorder(None, sum_of, Line(of(slope), 4), of(1, slope, 5))
        assert found.numpy().tolist() == [slope + 4, slope * slope + 4, 5 * slope + 4]
    assert recorder.n_recordings == len(calls) == 1


def test_other_numbers_of_the_host_are_recorded_anew():
    recorder = Recorder()
    for steps in (4, 5, 4):
        assert recorder(None, sum_of, Line(of(2), steps), of(1, 3)).numpy().tolist() == [
            2 + steps,
            6 + steps,
        ]
    assert recorder.n_recordings == 2


def test_what_belongs_to_another_key_is_recorded_anew():
    recorder = Recorder()
    for key in ("one", "other", "one"):
        recorder(key, sum_of, Line(of(1), 2), of(1, 2))
    assert recorder.n_recordings == 2


def test_recordings_are_forgotten_in_time():
    recorder = Recorder()
    for key in range(3 * MOST_KEYS):
        recorder(key, sum_of, Line(of(1), 2), of(1, 2))
    assert recorder.n_recordings == MOST_KEYS


def test_a_recorder_is_about_objects_and_not_what_they_equal():
    one, other = [1], [1]
    recorder = Recorder(one, None)
    assert recorder.is_about(one, None)
    assert not recorder.is_about(other, None)


def test_what_can_not_be_recorded_is_run():
    hidden = of(1, 2, 3)

    def function(x):
        calls.append(x)
        return dr.gather(mi.Float, hidden, dr.arange(mi.UInt32, 3)) * x

    recorder = Recorder()
    for factor in (2, 3):
        assert recorder(None, function, of(factor)).numpy().tolist() == [
            factor,
            2 * factor,
            3 * factor,
        ]
    calls.clear()
    recorder(None, function, of(4))
    assert len(calls) == 1, "it isn't tried again"
    calls.clear()
    for _ in range(2):
        recorder("another key", sum_of, Line(of(1), 2), of(1, 2))
    assert len(calls) == 1, "others are recorded"


def test_nothing_is_recorded_where_that_is_not_possible():
    recorder = Recorder(possible=False)
    for _ in range(2):
        recorder(None, sum_of, Line(of(1), 1), of(1, 2))
    assert recorder.n_recordings == 0


def test_errors_stay_what_they_are():
    class Late(Exception):
        pass

    def function(x):
        raise Late("at noon")

    with pytest.raises(Late, match="at noon"):
        Recorder()(None, function, of(1, 2))


def test_rays_are_counted_also_after_a_recording():
    def function(x):
        calls.append(x)
        return x + 1

    recorder = Recorder()
    recorder(None, function, of(1, 2))
    calls.clear()
    with count_rays():
        recorder(None, function, of(1, 2))
    assert len(calls) == 1


def test_what_was_recorded_is_interrupted_too():
    def count_up(limit, memory):
        i = dr.zeros(mi.UInt32, 64)
        return dr.while_loop(
            (i,), lambda i: (i < limit) & not_interrupted(memory, i), lambda i: (i + 1,)
        )[0]

    recorder = Recorder()
    few, forever = dr.opaque(mi.UInt32, 10), dr.opaque(mi.UInt32, 1 << 31)
    assert recorder(None, count_up, few, memory()).numpy().tolist() == 64 * [10]
    threading.Timer(0.3, os.kill, (os.getpid(), signal.SIGINT)).start()
    begin = time.perf_counter()
    with pytest.raises(KeyboardInterrupt), interruptible():
        recorder(None, count_up, forever, memory()).numpy()
    assert time.perf_counter() - begin < 2
    assert recorder(None, count_up, few, memory()).numpy().tolist() == 64 * [10]
    assert recorder.n_recordings == 1


def test_an_interrupt_while_something_is_recorded_is_one():
    def function(x):
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(1)
        return x + 1

    with pytest.raises(KeyboardInterrupt), interruptible():
        Recorder()(None, function, of(1, 2))
