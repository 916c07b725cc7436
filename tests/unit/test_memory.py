"""How much memory is free, as different systems say it."""

from __future__ import annotations

import math
from types import SimpleNamespace

import pytest

from envmap_integrator.system import memory
from envmap_integrator.system.memory import check_memory, free_memory

GB = 10**9


@pytest.fixture
def system(tmp_path, monkeypatch):
    """``system(...)``: a machine with 8 GB free, whose files hold this."""
    machine = SimpleNamespace(available=8 * GB)
    monkeypatch.setattr(memory.psutil, "virtual_memory", lambda: machine)

    def make(**files: str) -> None:
        for name, text in files.items():
            path = tmp_path / NAMES[name]
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)
        monkeypatch.setattr(memory, "_ROOT", tmp_path)

    return make


NAMES = {
    "groups": "proc/self/cgroup",
    "limit": "sys/fs/cgroup/user/job/memory.max",
    "used": "sys/fs/cgroup/user/job/memory.current",
    "stat": "sys/fs/cgroup/user/job/memory.stat",
    "outer_limit": "sys/fs/cgroup/user/memory.max",
    "outer_used": "sys/fs/cgroup/user/memory.current",
    "outer_stat": "sys/fs/cgroup/user/memory.stat",
}
GROUPS = "4:memory:/elsewhere\n0::/user/job\n"
STAT = f"anon 5\ninactive_file {GB}\n"


@pytest.mark.parametrize(
    ("files", "expected"),
    [
        ({}, 8 * GB),
        ({"groups": GROUPS}, 8 * GB),
        ({"groups": GROUPS, "limit": f"{4 * GB}\n", "used": f"{3 * GB}\n", "stat": STAT}, 2 * GB),
        ({"groups": GROUPS, "limit": "max\n", "used": f"{3 * GB}\n", "stat": STAT}, 8 * GB),
        ({"groups": GROUPS, "limit": f"{GB}\n", "used": f"{3 * GB}\n", "stat": STAT}, 0),
        (
            {"groups": GROUPS, "limit": "max\n", "used": "0\n", "stat": STAT}
            | {"outer_limit": f"{GB}\n", "outer_used": f"{GB}\n", "outer_stat": STAT},
            GB,
        ),
    ],
    ids=["machine", "no limits", "group", "unlimited group", "full group", "outer group"],
)
def test_the_least_limit_counts(system, files, expected):
    system(**files)
    assert free_memory() == pytest.approx(expected, abs=1024)


def test_a_system_that_says_nothing_has_a_limit_or_none(system):
    system()
    assert free_memory() > GB


def test_this_machine_has_some():
    assert 0.1 * GB < free_memory() < math.inf


def test_refusal(monkeypatch):
    monkeypatch.setattr(memory, "free_memory", lambda: 5.1 * GB)
    check_memory("ours", "40 maps", 5 * GB, "list fewer")
    expected = "^ours: 40 maps need 12.0 GB, 5.1 GB are free; list fewer$"
    with pytest.raises(ValueError, match=expected):
        check_memory("ours", "40 maps", 12 * GB, "list fewer")
