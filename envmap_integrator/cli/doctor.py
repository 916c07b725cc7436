"""The command ``doctor``: what this machine can render with, and what to do about the rest."""

from __future__ import annotations

import argparse
import importlib.util
import os
import platform
from collections.abc import Iterator
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
from rich.console import Console

import envmap_integrator
from envmap_integrator.system.checks import SUPPORTED_VARIANTS
from envmap_integrator.system.llvm import LLVMError, LLVMLibrary, ensure_llvm


@dataclass(frozen=True)
class Finding:
    """One line of the diagnosis; ``fix`` says what to do if anything is amiss."""

    subject: str
    finding: str
    fix: str = ""
    fatal: bool = False

    @property
    def mark(self) -> str:
        if self.fatal:
            return "[bold red]✗[/]"
        return "[yellow]•[/]" if self.fix else "[green]✓[/]"


def doctor(args: argparse.Namespace) -> int:
    """Print the diagnosis; return 1 if no variant can render with our integrators."""
    console = Console()
    findings = list(diagnose(console))
    for item in findings:
        fix = f" [dim]→ {item.fix}[/]" if item.fix else ""
        console.print(
            f"{item.mark} {item.subject}: {item.finding}{fix}", highlight=False, soft_wrap=True
        )
    return int(any(item.fatal for item in findings))


def diagnose(console: Console) -> Iterator[Finding]:
    """Look at everything that rendering depends on."""
    yield Finding("envmap_integrator", envmap_integrator.__version__)
    yield Finding("mitsuba", f"{mi.__version__}, drjit {dr.__version__}")
    yield Finding("python", f"{platform.python_version()} on {platform.platform()}")

    llvm = _llvm()
    gpu = bool(dr.has_backend(dr.JitBackend.CUDA))
    yield _llvm_finding(llvm, gpu)
    yield Finding("gpu", "CUDA" if gpu else "none; rendering runs on the CPU")
    yield Finding("threads", f"{dr.thread_count()} of {os.cpu_count()} cores")

    usable = usable_variants(llvm=isinstance(llvm, LLVMLibrary), cuda=gpu)
    yield Finding(
        "variants",
        ", ".join(usable) or "none that our integrators work with",
        fix="" if usable else "fix libLLVM above",
        fatal=not usable,
    )
    denoiser = importlib.util.find_spec("mitsuba_oidn")
    yield Finding(
        "denoiser",
        "Open Image Denoise" if denoiser else "none (optional)",
        fix="" if denoiser else "pip install mitsuba-oidn",
    )
    terminal = "colours and progress bars" if console.is_terminal else "plain (not a terminal)"
    yield Finding("terminal", terminal)


def usable_variants(llvm: bool, cuda: bool) -> list[str]:
    """Variants that our integrators support and that can run here, given these back-ends."""
    available = {"llvm": llvm, "cuda": cuda}
    return [
        variant
        for variant in SUPPORTED_VARIANTS
        if variant in mi.variants() and available[variant.split("_")[0]]
    ]


def _llvm() -> LLVMLibrary | LLVMError:
    try:
        return ensure_llvm()
    except LLVMError as error:
        return error


def _llvm_finding(llvm: LLVMLibrary | LLVMError, gpu: bool) -> Finding:
    if isinstance(llvm, LLVMLibrary):
        return Finding("libLLVM", str(llvm))
    found, _, fix = str(llvm).rpartition(": ")
    return Finding("libLLVM", found, fix, fatal=not gpu)
