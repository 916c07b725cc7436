"""Where the time went."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from contextlib import contextmanager

import drjit as dr


@contextmanager
def measure(seconds: dict[str, float], stage: str) -> Iterator[None]:
    """Store the wall time of a block [s] as ``seconds[stage]``, kernels it launched included."""
    start = time.perf_counter()
    try:
        yield
    finally:
        dr.sync_thread()
        seconds[stage] = time.perf_counter() - start


@contextmanager
def record_kernels() -> Iterator[None]:
    """Have :func:`compilation_time` know of the kernels that the block launches."""
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        dr.kernel_history_clear()
        yield


def compilation_time() -> float:
    """Seconds spent on compiling kernels since :func:`record_kernels` or the last call."""
    return math.fsum(
        (kernel["codegen_time"] + kernel["backend_time"]) / 1000
        for kernel in dr.kernel_history([dr.KernelType.JIT])
        if not kernel["cache_hit"]
    )
