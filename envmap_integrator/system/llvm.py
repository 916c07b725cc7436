"""Find a libLLVM that Dr.Jit can work with, before Dr.Jit picks one that it can't.

Dr.Jit compiles its CPU kernels with whatever ``libLLVM`` the machine offers, and loads it while
``drjit`` is imported. It declines versions up to 14, and accepts 15 and 16, whose x86 back-end
then *aborts the process* at the first kernel with a minimum or maximum in it (``Cannot select
... fminimum``). This module chooses a better library while there is time
(:func:`prefer_good_library`) and turns the abort into an error that says what to do
(:func:`ensure_llvm`).
"""

from __future__ import annotations

import glob
import os
import re
import sys
from dataclasses import dataclass
from pathlib import Path

MIN_VERSION = 17
"""Oldest usable major version: the first whose x86 back-end lowers ``fminimum``/``fmaximum``."""

ENV_VARIABLE = "DRJIT_LIBLLVM_PATH"

_SEARCH_PATTERNS = {
    "linux": (
        "/usr/lib/*-linux-gnu/libLLVM*.so*",
        "/usr/lib64/libLLVM*.so*",
        "/usr/lib/libLLVM*.so*",
        "/usr/lib/llvm*/lib/libLLVM*.so*",
        "/usr/lib64/llvm*/lib*/libLLVM*.so*",
        "/usr/lib/wsl/lib/libLLVM*.so*",
    ),
    "darwin": (
        "/opt/homebrew/Cellar/llvm*/*/lib/libLLVM.dylib",
        "/usr/local/Cellar/llvm*/*/lib/libLLVM.dylib",
    ),
    "win32": (r"C:\Program Files\LLVM\bin\LLVM-C.dll",),
}

_INSTALL_COMMANDS = {
    "apt-get": "apt-get install libllvm19",
    "dnf": "dnf install llvm-libs",
    "pacman": "pacman -S llvm-libs",
}

_VERSION_PATTERNS = (
    re.compile(r"libLLVM(?:\.so\.|-)(\d+)"),
    re.compile(r"/llvm(?:@\d+)?/(\d+)[^/]*/lib/"),
)


class LLVMError(RuntimeError):
    """No usable libLLVM; the message is one line and says what to do."""


@dataclass(frozen=True)
class LLVMLibrary:
    """A shared library, and its version as far as known: ``(19,)`` or ``(19, 1, 7)``."""

    path: Path | None
    version: tuple[int, ...]

    @property
    def usable(self) -> bool:
        return self.version[0] >= MIN_VERSION

    def __str__(self) -> str:
        number = ".".join(map(str, self.version))
        return f"LLVM {number} ({self.path or 'path unknown'})"


def library_at(path: str | os.PathLike) -> LLVMLibrary | None:
    """Read a library's version off the name of the file that ``path`` leads to.

    Loading the library to ask it would be surer, but its symbols would stay in the process.
    """
    target = Path(os.path.realpath(path))
    for pattern in _VERSION_PATTERNS:
        if match := pattern.search(target.as_posix()):
            return LLVMLibrary(target, (int(match[1]),))
    return None


def installed_libraries() -> list[LLVMLibrary]:
    """Libraries in the places where systems keep them, newest first, each once."""
    paths = (path for pattern in _patterns() for path in glob.glob(pattern))
    found = {library for path in paths if (library := library_at(path))}
    return sorted(found, key=lambda library: (library.version, str(library.path)), reverse=True)


def prefer_good_library() -> None:
    """Point Dr.Jit to the newest usable library, unless the user chose one or Dr.Jit has.

    Silent and safe in every case: users of ``cuda_*`` and ``scalar_*`` variants need no LLVM.
    """
    if os.environ.get(ENV_VARIABLE) or "drjit" in sys.modules:
        return
    best = next(iter(installed_libraries()), None)
    if best and best.usable:
        os.environ[ENV_VARIABLE] = str(best.path)


def ensure_llvm() -> LLVMLibrary:
    """Return the library that Dr.Jit has loaded; raise :class:`LLVMError` if it can't be used."""
    import drjit as dr

    version = dr.detail.llvm_version()
    if version[0] >= MIN_VERSION:
        return LLVMLibrary(_loaded_path(), version)
    raise LLVMError(_explanation(version))


def _patterns() -> tuple[str, ...]:
    return _SEARCH_PATTERNS.get(sys.platform, ())


def _loaded_path() -> Path | None:
    """Path of the libLLVM mapped into this process (Linux), else the one that was asked for."""
    try:
        with open("/proc/self/maps") as maps:
            for line in maps:
                if "libLLVM" in line:
                    return Path(line.split(maxsplit=5)[-1].strip())
    except OSError:
        pass
    chosen = os.environ.get(ENV_VARIABLE)
    return Path(chosen) if chosen else None


def _explanation(version: tuple[int, ...]) -> str:
    """One line: what Dr.Jit has found, what it needs, and how to give it that."""
    # A version of -1 means that Dr.Jit has no LLVM backend, perhaps since it declined the library.
    path = _loaded_path()
    library = LLVMLibrary(path, version) if version[0] > 0 else path and library_at(path)
    found = f"Dr.Jit found {library}" if library else "Dr.Jit found no libLLVM"
    chosen = os.environ.get(ENV_VARIABLE)
    if chosen:
        found += f" through {ENV_VARIABLE}"

    best = next(iter(installed_libraries()), None)
    if best and best.usable:
        fix = (
            f"set {ENV_VARIABLE}={best.path}"
            if chosen
            else f"import envmap_integrator before mitsuba, or set {ENV_VARIABLE}={best.path}"
        )
    else:
        fix = _install_hint()
    return f"{found}, but the llvm_* variants need LLVM {MIN_VERSION} or newer: {fix}"


def _install_hint() -> str:
    from shutil import which

    if sys.platform == "darwin":
        return "brew install llvm"
    if sys.platform == "win32":
        return f"install LLVM from https://releases.llvm.org and set {ENV_VARIABLE} to LLVM-C.dll"
    commands = [command for tool, command in _INSTALL_COMMANDS.items() if which(tool)]
    return commands[0] if commands else f"install libLLVM {MIN_VERSION} or newer (libllvm19)"
