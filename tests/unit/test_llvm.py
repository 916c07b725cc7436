"""The choice of libLLVM, without loading any but the one in use."""

import os
import subprocess
import sys
import time
from pathlib import Path

import drjit as dr
import pytest

from envmap_integrator.system import llvm

OLD_VERSIONS = (14, 15, 16)


def fake_libraries(monkeypatch, folder: Path, *names: str) -> None:
    """Make the search find empty files of these names only."""
    for name in names:
        (folder / name).touch()
    monkeypatch.setitem(llvm._SEARCH_PATTERNS, sys.platform, (f"{folder}/libLLVM*",))


@pytest.fixture
def before_drjit(monkeypatch):
    """As at the start of a process: no choice made, Dr.Jit not imported."""
    monkeypatch.setenv(llvm.ENV_VARIABLE, "")
    monkeypatch.delitem(sys.modules, "drjit")


@pytest.mark.parametrize(
    ("path", "major"),
    [
        ("libLLVM-16.so.1", 16),
        ("libLLVM-14.0.6.so.1", 14),
        ("libLLVM.so.19.1", 19),
        ("libLLVM.so.18", 18),
        ("Cellar/llvm/20.1.8/lib/libLLVM.dylib", 20),
        ("Cellar/llvm@17/17.0.6/lib/libLLVM.dylib", 17),
    ],
)
def test_version_is_read_off_the_path(tmp_path, path, major):
    assert llvm.library_at(tmp_path / path).version == (major,)


def test_version_is_that_of_a_links_target(tmp_path):
    target = tmp_path / "libLLVM.so.19.1"
    target.touch()
    link = tmp_path / "libLLVM.so"
    link.symlink_to(target)
    assert llvm.library_at(link) == llvm.LLVMLibrary(target.resolve(), (19,))


def test_a_name_without_version_is_not_guessed(tmp_path):
    assert llvm.library_at(tmp_path / "libLLVM.so") is None


def test_installed_libraries_are_sorted_and_unique(monkeypatch, tmp_path):
    fake_libraries(monkeypatch, tmp_path, "libLLVM-15.so.1", "libLLVM.so.19.1", "libLLVM-9.so.1")
    (tmp_path / "libLLVM-19.so").symlink_to("libLLVM.so.19.1")
    assert [library.version for library in llvm.installed_libraries()] == [(19,), (15,), (9,)]


def test_newest_good_library_is_preferred(monkeypatch, tmp_path, before_drjit):
    fake_libraries(monkeypatch, tmp_path, "libLLVM-14.so.1", "libLLVM-15.so.1", "libLLVM.so.19.1")
    llvm.prefer_good_library()
    assert os.environ[llvm.ENV_VARIABLE] == str((tmp_path / "libLLVM.so.19.1").resolve())


def test_no_preference_among_bad_libraries(monkeypatch, tmp_path, before_drjit):
    fake_libraries(monkeypatch, tmp_path, "libLLVM-14.so.1", "libLLVM-16.so.1")
    llvm.prefer_good_library()
    assert not os.environ[llvm.ENV_VARIABLE]


def test_the_users_choice_stands(monkeypatch, tmp_path, before_drjit):
    fake_libraries(monkeypatch, tmp_path, "libLLVM.so.19.1")
    monkeypatch.setenv(llvm.ENV_VARIABLE, "/opt/libLLVM-18.so.1")
    llvm.prefer_good_library()
    assert os.environ[llvm.ENV_VARIABLE] == "/opt/libLLVM-18.so.1"


def test_too_late_once_drjit_is_imported(monkeypatch, tmp_path):
    fake_libraries(monkeypatch, tmp_path, "libLLVM.so.19.1")
    monkeypatch.setenv(llvm.ENV_VARIABLE, "")
    llvm.prefer_good_library()
    assert not os.environ[llvm.ENV_VARIABLE]


def test_the_library_in_use_is_usable_and_cheap_to_check():
    library = llvm.ensure_llvm()
    assert library.usable
    start = time.perf_counter()
    assert llvm.ensure_llvm() == library
    assert time.perf_counter() - start < 0.05


@pytest.mark.parametrize("version", [(15, 0, 6), (16, 0, 6), (-1, -1, -1)])
def test_error_names_the_package_to_install(monkeypatch, tmp_path, version):
    fake_libraries(monkeypatch, tmp_path)
    monkeypatch.setattr(dr.detail, "llvm_version", lambda: version)
    with pytest.raises(llvm.LLVMError, match="(?i)llvm 17 or newer: .*llvm") as caught:
        llvm.ensure_llvm()
    assert "\n" not in str(caught.value)


def test_error_names_the_good_library_if_there_is_one(monkeypatch, tmp_path):
    fake_libraries(monkeypatch, tmp_path, "libLLVM.so.19.1")
    monkeypatch.setattr(dr.detail, "llvm_version", lambda: (15, 0, 6))
    with pytest.raises(llvm.LLVMError, match=r"DRJIT_LIBLLVM_PATH=.*libLLVM\.so\.19\.1"):
        llvm.ensure_llvm()


@pytest.mark.parametrize("version", OLD_VERSIONS)
def test_an_old_library_gives_an_error_and_no_abort(version):
    """With a real one, where the machine has it."""
    old = [library for library in llvm.installed_libraries() if library.version[0] == version]
    if not old:
        pytest.skip(f"LLVM {version} is not installed")
    program = "from envmap_integrator.system.llvm import ensure_llvm; ensure_llvm()"
    environment = os.environ | {llvm.ENV_VARIABLE: str(old[0].path)}
    process = subprocess.run(
        [sys.executable, "-c", program], env=environment, capture_output=True, text=True
    )
    assert process.returncode == 1
    assert f"Dr.Jit found LLVM {version}" in process.stderr.splitlines()[-1]
