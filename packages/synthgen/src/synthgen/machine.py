"""Resources of the machine for this process: cores, memory, disk, shared memory."""

import os
import shutil
from dataclasses import dataclass
from pathlib import Path

from posecore.errors import StorageError

_CGROUP = Path("/sys/fs/cgroup")
_SPARE_BYTES = 256 * 2**20  # left free on the disk


@dataclass(frozen=True, kw_only=True)
class Machine:
    """Available resources.

    Attributes:
        cores: Number of cores for this process.
        cpu: Name of the processor.
        memory_bytes: Memory, or the container's limit where that is less.
        shared_bytes: Size of /dev/shm, 0 without one.
    """

    cores: float
    cpu: str
    memory_bytes: int
    shared_bytes: int


def machine() -> Machine:
    """Resources of this machine."""
    return Machine(
        cores=min(float(cores()), _cgroup_cores()),
        cpu=_cpu_name(),
        memory_bytes=memory_bytes(),
        shared_bytes=shutil.disk_usage("/dev/shm").total if Path("/dev/shm").is_dir() else 0,
    )


def cores() -> int:
    """Number of cores that this process may be scheduled on."""
    return len(os.sched_getaffinity(0))


def memory_bytes() -> int:
    """Memory of the machine, or the control group's limit where that is less."""
    physical = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    limits = [_number(_CGROUP / "memory.max"), _number(_CGROUP / "memory" / "memory.limit_in_bytes")]
    return min([physical, *(limit for limit in limits if limit)])


def free_bytes(path: Path) -> int:
    """Free space on the disk of a folder, or of its nearest existing parent."""
    folder = path.absolute()
    while not folder.exists():
        folder = folder.parent
    return shutil.disk_usage(folder).free


def require_free_space(url: str, needed_bytes: int) -> None:
    """Check that the disk of a folder, or of its nearest existing parent, has room; URLs are not checked.

    Args:
        url: Dataset.
        needed_bytes: Bytes still to be written there.

    Raises:
        StorageError: Less is free than needed; the message names both and the remedies.
    """
    if "://" in url:
        return
    free = free_bytes(Path(url))
    if free < needed_bytes + _SPARE_BYTES:
        raise StorageError(
            f"{url}: {size_text(free)} free, about {size_text(needed_bytes + _SPARE_BYTES)} needed; free some space, "
            "choose another --out, or a smaller --n"
        )


def _cgroup_cores() -> float:
    """CPU quota of the control group in cores, infinite without a limit."""
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
