"""Who hears of Ctrl-C, and who doesn't."""

from __future__ import annotations

import os
import signal
import threading
import time

import drjit as dr
import mitsuba as mi
import pytest

from envmap_integrator.system import interrupt
from envmap_integrator.system.interrupt import interruptible, memory, not_interrupted

pytestmark = pytest.mark.usefixtures("variant")

FOREVER = 1 << 31


def press_soon(delay: float = 0.3) -> None:
    threading.Timer(delay, os.kill, (os.getpid(), signal.SIGINT)).start()


def count_up(limit: int) -> mi.UInt32:
    """How far lanes get."""
    i = dr.zeros(mi.UInt32, 64)
    return dr.while_loop(
        (i,),
        lambda i: (i < dr.opaque(mi.UInt32, limit)) & not_interrupted(memory(), i),
        lambda i: (i + 1,),
    )[0]


def test_a_kernel_stops():
    press_soon()
    begin = time.perf_counter()
    with pytest.raises(KeyboardInterrupt), interruptible():
        count_up(FOREVER).numpy()
    assert time.perf_counter() - begin < 2


def test_the_next_one_does_not():
    press_soon()
    with pytest.raises(KeyboardInterrupt), interruptible():
        count_up(FOREVER).numpy()
    with interruptible():
        assert count_up(1000).numpy().tolist() == 64 * [1000]


def test_what_came_of_it_in_other_code_is_an_interrupt_again():
    press_soon()
    with pytest.raises(KeyboardInterrupt), interruptible():
        try:
            time.sleep(1)
        except KeyboardInterrupt:
            raise RuntimeError("as C++ has it") from None


def test_other_errors_pass():
    with pytest.raises(RuntimeError, match="ours"), interruptible():
        raise RuntimeError("ours")


def test_programs_that_handle_the_signal_are_left_alone():
    received = []
    before = signal.signal(signal.SIGINT, lambda *_: received.append(True))
    try:
        press_soon()
        with interruptible():
            time.sleep(0.6)
            assert count_up(1000).numpy().tolist() == 64 * [1000]
        assert received
    finally:
        signal.signal(signal.SIGINT, before)


def test_other_threads_are_left_alone():
    found = []

    def work():
        with interruptible():
            found.append(count_up(1000).numpy()[0])

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert found == [1000]


def test_blocks_may_nest():
    press_soon()
    ended = threading.Event()
    with pytest.raises(KeyboardInterrupt), interruptible(otherwise=ended.set):
        with interruptible():
            count_up(FOREVER).numpy()
    assert not ended.is_set()


def test_what_cannot_stop_is_ended_otherwise(monkeypatch):
    monkeypatch.setattr(interrupt, "PATIENCE", 0.1)
    ended = threading.Event()
    press_soon()
    with pytest.raises(KeyboardInterrupt), interruptible(otherwise=ended.set):
        try:
            time.sleep(1)
        finally:  # As code in C++ that doesn't listen.
            assert ended.wait(2)


def test_nothing_is_left_behind():
    n_threads, descriptors = threading.active_count(), len(os.listdir("/proc/self/fd"))
    for _ in range(10):
        with interruptible():
            pass
    assert threading.active_count() == n_threads
    assert len(os.listdir("/proc/self/fd")) == descriptors
    assert signal.set_wakeup_fd(-1) == -1
