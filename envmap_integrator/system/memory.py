"""What needs more memory than there is gets refused before it's begun, with advice."""

from __future__ import annotations

from pathlib import Path

import psutil

_ROOT = Path("/")


def check_memory(owner: str, what: str, needed: float, advice: str) -> None:
    """Raise ``ValueError`` if ``what`` needs more than is free: an estimate of ``needed`` bytes."""
    free = free_memory()
    if needed > free:
        raise ValueError(
            f"{owner}: {what} need {needed / 1e9:.1f} GB, {free / 1e9:.1f} GB are free; {advice}"
        )


def free_memory() -> float:
    """Bytes that this process can still take: of the machine, and of its control groups."""
    return min(float(psutil.virtual_memory().available), *map(_of_group, _groups()))


def _groups() -> list[Path]:
    """Folders of the control groups that we belong to, of which each may have a limit."""
    root = _ROOT / "sys/fs/cgroup"
    try:
        entries = (_ROOT / "proc/self/cgroup").read_text().splitlines()
    except OSError:
        return [root]
    own = root / next((e.partition("::/")[2] for e in entries if e.startswith("0::/")), "")
    return [group for group in (own, *own.parents) if group.is_relative_to(root)]


def _of_group(group: Path) -> float:
    """What a control group leaves; files that the system keeps in memory don't count."""
    try:
        limit = float((group / "memory.max").read_text().replace("max", "inf"))
        used = int((group / "memory.current").read_text())
        numbers = dict(map(str.split, (group / "memory.stat").read_text().splitlines()))
        return max(limit - used + int(numbers["inactive_file"]), 0.0)
    except (OSError, ValueError, KeyError):
        return float("inf")
