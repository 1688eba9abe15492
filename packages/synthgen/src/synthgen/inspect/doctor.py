"""What this machine has of what rendering needs, and what to do about the rest."""

import json
import platform
import re
import signal
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

from posecore.errors import RenderError

from synthgen.config import SynthConfig
from synthgen.engine import ENGINE_NAMES
from synthgen.engines.devices import list_gpus
from synthgen.inspect.speed import Speed
from synthgen.machine import free_bytes, machine
from synthgen.pairs.data_card import versions

State = Literal["ok", "warning", "missing"]

_PROBE_TIMEOUT_S = 120
_GB = 1e9
_SMALL_SHM_BYTES = 64 * 2**20  # what Docker gives unless told otherwise
_PACKAGES = {  # shared libraries that Blender and EGL load, and the Debian packages that hold them
    "libEGL": "libegl1",
    "libGL": "libgl1",
    "libICE": "libice6",
    "libSM": "libsm6",
    "libX11": "libx11-6",
    "libXfixes": "libxfixes3",
    "libXi": "libxi6",
    "libXrender": "libxrender1",
    "libXxf86vm": "libxxf86vm1",
    "libgomp": "libgomp1",
    "libxkbcommon": "libxkbcommon0",
}
_BPY = "import bpy, sys; sys.stdout.write('\\n' + bpy.app.version_string)"
_GL = (
    "import json, sys; from posecore.raster import Rasteriser; r = Rasteriser({}); "
    "sys.stdout.write('\\n' + json.dumps([r.device, r.is_software]))"
)


@dataclass(frozen=True, kw_only=True)
class Found:
    """One thing that was looked at: its state, what was found, and what to do where that is needed."""

    name: str
    state: State
    text: str
    remedy: str = ""


@dataclass(frozen=True, kw_only=True)
class Engines:
    """Engines that can run here, the path tracer first, and whether GL is drawn by the processor."""

    names: tuple[str, ...]
    software_gl: bool

    def worth_measuring(self) -> tuple[str, ...]:
        """Those to measure when none is asked for: EEVEE on software GL is for nothing but tests."""
        return tuple(name for name in self.names if name != "eevee" or not self.software_gl)


def look(out: Path, wanted: Sequence[str]) -> tuple[list[Found], Engines]:
    """Look at this machine; nothing is rendered.

    Args:
        out: Where a dataset would go.
        wanted: Engines that must work; none: what is missing for one that another can stand for is a warning.

    Returns:
        What was found, and the engines that can run.
    """
    gl, software = _gl()
    blender = _blender(needed=bool({"cycles", "eevee"} & set(wanted)))
    names = (
        [name for name in ENGINE_NAMES if name == "raster" or blender.state == "ok"] if gl.state != "missing" else []
    )
    found = [
        Found(name="python", state="ok", text=f"{platform.python_version()}, {platform.platform()}"),
        Found(name="versions", state="ok", text=", ".join(f"{k} {v}" for k, v in versions(SynthConfig()).items())),
        blender,
        gl,
        _gpus(blender),
        *_resources(out),
    ]
    return found, Engines(names=tuple(names), software_gl=software)


def disk_found(speeds: Sequence[Speed], n: int, out: Path) -> list[Found]:
    """Whether what was measured fits on the disk at `out`."""
    free = free_bytes(out)
    return [
        Found(
            name="disk space",
            state="missing",
            text=f"{n} pairs of {s.engine} take {n * s.bytes_per_pair / _GB:.3g} GB, "
            f"free at {out} are {free / _GB:.3g} GB",
            remedy="free some space, give another --out, or render fewer pairs",
        )
        for s in speeds
        if s.pairs and n * s.bytes_per_pair > free
    ]


def as_text(found: Sequence[Found], speeds: Sequence[Speed], n: int) -> str:
    """Everything as a table."""
    lines = []
    for item in found:
        lines.append(f"{item.state:<8} {item.name:<11} {item.text}")
        if item.remedy:
            lines.append(f"{'':<20} -> {item.remedy}")
    for speed in speeds:
        state = "ok" if speed.pairs else "missing"
        lines.append(f"{state:<8} {speed.engine:<11} {speed.text(n)}")
    return "\n".join(lines)


def as_json(found: Sequence[Found], speeds: Sequence[Speed], n: int) -> str:
    """Everything as one JSON object."""
    measured = [asdict(s) | {"pairs_per_s": s.pairs_per_s, "n": n, "hours": s.hours(n)} for s in speeds]
    return json.dumps({"found": [asdict(item) for item in found], "speed": measured}, indent=1)


def _blender(needed: bool) -> Found:
    state: State = "missing" if needed else "warning"
    ok, said = _asked(_BPY)
    if ok:
        return Found(name="bpy", state="ok", text=said)
    return Found(
        name="bpy",
        state=state,
        text=said,
        remedy=_library_remedy(said)
        or "pip install 'bpy>=4.5,<4.6' (needs Python 3.11); --engine raster works without it",
    )


def _gl() -> tuple[Found, bool]:
    ok, said = _asked(_GL)
    if not ok:
        remedy = _library_remedy(said) or "install a GPU driver with EGL, or Mesa (Debian: libegl1 libgl1-mesa-dri)"
        return Found(name="GL", state="missing", text=said, remedy=remedy), False
    device, software = json.loads(said)
    if not software:
        return Found(name="GL", state="ok", text=f"{device}; labels of another driver may differ along edges"), False
    return (
        Found(
            name="GL",
            state="warning",
            text=f"{device}, drawn by the processor: hypotheses, labels and the engines raster and eevee are slower",
            remedy="on a machine with a GPU, install its driver with EGL; keep to one kind within a dataset",
        ),
        True,
    )


def _gpus(blender: Found) -> Found:
    if blender.state != "ok":
        return Found(name="GPUs", state="warning", text="unknown: Blender does not start")
    try:
        gpus = list_gpus()
    except RenderError as error:
        return Found(name="GPUs", state="warning", text=str(error))
    if not gpus:
        return Found(name="GPUs", state="ok", text="none that Cycles can use: it traces on the processor")
    listed = ", ".join(f"{count} {kind}" for kind, count in gpus.items())
    return Found(name="GPUs", state="ok", text=f"{listed}; use --device auto")


def _resources(out: Path) -> list[Found]:
    here = machine()
    shared = f"{here.shared_bytes / _GB:.3g} GB"
    small = here.shared_bytes <= _SMALL_SHM_BYTES
    return [
        Found(name="cores", state="ok", text=f"{here.cores:g} of {here.cpu}"),
        Found(name="memory", state="ok", text=f"{here.memory_bytes / _GB:.3g} GB"),
        Found(name="disk", state="ok", text=f"{free_bytes(out) / _GB:.4g} GB free at {out}"),
        Found(
            name="/dev/shm",
            state="warning" if small else "ok",
            text=shared,
            remedy="Blender's pictures pass through it; start the container with --shm-size=1g" if small else "",
        ),
    ]


def _asked(code: str) -> tuple[bool, str]:
    """Run Python code in another process: a crash or a missing library is found, not suffered."""
    try:
        run = subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, timeout=_PROBE_TIMEOUT_S, check=False
        )
    except subprocess.TimeoutExpired:
        return False, f"no answer for {_PROBE_TIMEOUT_S} s"
    if run.returncode == 0:
        return True, run.stdout.splitlines()[-1]
    if run.returncode < 0:
        return False, f"crashes ({signal.Signals(-run.returncode).name})"
    return False, (run.stderr.strip().splitlines() or ["fails without a word"])[-1]


def _library_remedy(said: str) -> str:
    """What to install when the loader misses a shared library."""
    missing = re.search(r"(lib[\w+-]+)(\.so[.\d]*): cannot open shared object file", said)
    if missing is None:
        return ""
    name, package = missing.group(1) + missing.group(2), _PACKAGES.get(missing.group(1))
    return (
        f"apt-get install {package}" if package else f"install the package that holds {name} (apt-file search {name})"
    )
