"""What the machine gives to this process: cores, memory, disk, shared memory."""

import os
import shutil
from dataclasses import dataclass
from pathlib import Path

_CGROUP = Path("/sys/fs/cgroup")


@dataclass(frozen=True, kw_only=True)
class Machine:
    """What may be used here.

    Attributes:
        cores: Cores that this process may run on.
        cpu: Name of the processor.
        memory_bytes: Memory, or the container's limit where that is less.
        shared_bytes: Size of /dev/shm, 0 without one.
    """

    cores: float
    cpu: str
    memory_bytes: int
    shared_bytes: int


def machine() -> Machine:
    """Look at this machine."""
    return Machine(
        cores=min(float(cores()), _cgroup_cores()),
        cpu=_cpu_name(),
        memory_bytes=memory_bytes(),
        shared_bytes=shutil.disk_usage("/dev/shm").total if Path("/dev/shm").is_dir() else 0,
    )


def cores() -> int:
    """Cores that this process may be scheduled on."""
    return len(os.sched_getaffinity(0))


def memory_bytes() -> int:
    """Memory of the machine, or the control group's limit where that is less."""
    physical = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    limits = [_number(_CGROUP / "memory.max"), _number(_CGROUP / "memory" / "memory.limit_in_bytes")]
    return min([physical, *(limit for limit in limits if limit)])


def free_bytes(path: Path) -> int:
    """Free space where a folder is, or would be made."""
    place = path.absolute()
    while not place.exists():
        place = place.parent
    return shutil.disk_usage(place).free


def _cgroup_cores() -> float:
    """Cores' worth of time that the control group grants, infinite without a limit."""
    words = _text(_CGROUP / "cpu.max").split()
    if len(words) == 2 and words[0] != "max":
        return int(words[0]) / int(words[1])
    quota, period = _number(_CGROUP / "cpu" / "cpu.cfs_quota_us"), _number(_CGROUP / "cpu" / "cpu.cfs_period_us")
    return quota / period if quota and period else float("inf")


def _cpu_name() -> str:
    for line in _text(Path("/proc/cpuinfo")).splitlines():
        if line.startswith("model name"):
            return line.split(":", 1)[1].strip()
    return "unknown processor"


def _number(file: Path) -> int | None:
    text = _text(file)
    return int(text) if text.isdigit() else None


def _text(file: Path) -> str:
    try:
        return file.read_text(encoding="utf-8").strip()
    except OSError:
        return ""


def size_text(size_bytes: float) -> str:
    """A size in words: 940 kB, 1.2 MB, 23.6 GB."""
    unit, factor = next((u, f) for u, f in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)) if size_bytes >= f or u == "kB")
    return f"{size_bytes / factor:.3g} {unit}"
