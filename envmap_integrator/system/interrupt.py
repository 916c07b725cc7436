"""Ctrl-C while a kernel runs.

Python's handler of the signal runs in the main thread, which waits for the kernel: that may take
minutes. Another thread hears of the signal at once, and writes it where kernels look.
"""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import drjit as dr
import mitsuba as mi
import numpy as np

#: Seconds in which the block of ``interruptible`` may end by itself after Ctrl-C.
PATIENCE = 1.5

#: Not zero after Ctrl-C. On the CPU, kernels read it where it is; on a GPU, they read a copy, and
#: aren't stopped.
_memory = np.zeros(64, np.uint32)


@contextmanager
def interruptible(otherwise: Callable[[], None] | None = None) -> Iterator[None]:
    """In the block, lanes of kernels that ask ``not_interrupted()`` learn of Ctrl-C.

    The block ends in ``KeyboardInterrupt`` as soon as the kernel has ended; what a kernel computes
    that has been stopped is worthless. ``otherwise()`` is called, in another thread, if the block
    hasn't been left :data:`PATIENCE` after Ctrl-C.

    Does nothing outside the main thread, and in programs that handle the signal themselves: they
    may want to go on.
    """
    in_main_thread = threading.current_thread() is threading.main_thread()
    if not in_main_thread or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield
        return
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    outer = signal.set_wakeup_fd(writer, warn_on_full_buffer=False)
    pressed, left = threading.Event(), threading.Event()
    watch = (reader, outer, pressed, left, otherwise)
    watcher = threading.Thread(target=_watch, args=watch, daemon=True)
    watcher.start()
    error = None
    try:
        yield
        dr.sync_thread()
    except Exception as caught:
        error = caught
    finally:
        left.set()
        signal.set_wakeup_fd(outer)
        os.close(writer)
        watcher.join()
        os.close(reader)
        dr.sync_thread()  # What still runs has to learn of the end.
        _memory[:] = 0
    if error is not None:
        if pressed.is_set():  # Code in C++ makes other exceptions of it.
            raise KeyboardInterrupt from error
        raise error


def _watch(reader, outer, pressed, left, otherwise) -> None:
    while received := os.read(reader, 1):  # Numbers of signals; nothing once the pipe is closed.
        if received[0] == signal.SIGINT:
            _memory[:] = 1
            pressed.set()
        if outer >= 0:
            os.write(outer, received)
        if pressed.is_set() and otherwise and not left.wait(PATIENCE):
            otherwise()


def memory() -> mi.UInt32:
    """Where kernels look."""
    return mi.UInt32(_memory)


def not_interrupted(memory: mi.UInt32, step: mi.UInt32) -> mi.Bool:
    """Whether Ctrl-C hasn't been pressed, as kernels see it in ``memory()`` while they run.

    ``step`` counts what the kernel repeats: without it, the compiler would look once and for all.
    """
    return dr.gather(mi.UInt32, memory, step % len(_memory)) == 0


def was_interrupted() -> bool:
    """Whether Ctrl-C has been pressed in a block of ``interruptible``."""
    return bool(_memory[0])
