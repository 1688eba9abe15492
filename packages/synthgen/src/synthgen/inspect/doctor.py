"""Requirements of rendering, checked on this machine, with remedies and measured speed."""

import json
import platform
import re
import signal
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

from posecore.errors import RenderError
from posecore.mesh import Units, load_mesh

from synthgen.config import SynthConfig
from synthgen.engines.devices import list_gpus
from synthgen.inspect.speed import EngineSpeed, measure_engine
from synthgen.machine import free_bytes, machine
from synthgen.names import ENGINE_NAMES, EngineName
from synthgen.pairs.data_card import versions

State = Literal["ok", "warning", "missing"]

_PROBE_TIMEOUT_S = 600
_GB = 1e9
_SMALL_SHM_BYTES = 64 * 2**20  # Docker's default
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
class MachineCheck:
    """One checked requirement: its state, the finding, and the remedy where one is needed."""

    name: str
    state: State
    text: str
    remedy: str = ""


@dataclass(frozen=True, kw_only=True)
class UsableEngines:
    """Engines that can run here, the path tracer first, and whether the processor draws GL."""

    names: tuple[EngineName, ...]
    software_gl: bool

    def worth_measuring(self) -> tuple[EngineName, ...]:
        """Engines to measure by default: EEVEE on software GL serves tests alone."""
        return tuple(name for name in self.names if name != "eevee" or not self.software_gl)


@dataclass(frozen=True, kw_only=True)
class DoctorJob:
    """A planned dataset.

    Attributes:
        config: Recipe.
        n: Number of pairs.
        engines: Engines that must work; empty: any one will do.
        seconds: Measuring time, divided between the engines; 0 measures nothing.
        mesh: Object to measure with; None for a simple one.
        units: Unit of the mesh.
        out: Folder of the dataset.
    """

    config: SynthConfig
    n: int
    engines: tuple[EngineName, ...] = ()
    seconds: float = 30.0
    mesh: Path | None = None
    units: Units = "mm"
    out: Path = Path()


@dataclass(frozen=True, kw_only=True)
class DoctorReport:
    """Checks of this machine and the speed of its engines.

    Attributes:
        checks: Checked requirements.
        speeds: Measured engines.
        n: Number of planned pairs.
    """

    checks: tuple[MachineCheck, ...]
    speeds: tuple[EngineSpeed, ...]
    n: int

    @property
    def missing(self) -> list[str]:
        """Names of missing requirements and of engines that could not be measured."""
        return [check.name for check in self.checks if check.state == "missing"] + [
            speed.engine for speed in self.speeds if speed.measured is None
        ]

    def as_text(self) -> str:
        """The report as a table."""
        lines = []
        for check in self.checks:
            lines.append(f"{check.state:<8} {check.name:<11} {check.text}")
            if check.remedy:
                lines.append(f"{'':<20} -> {check.remedy}")
        for speed in self.speeds:
            state = "ok" if speed.measured else "missing"
            lines.append(f"{state:<8} {speed.engine:<11} {speed.text(self.n)}")
        return "\n".join(lines)

    def as_json(self) -> str:
        """The report as one JSON object."""
        speeds = [speed.as_dict(self.n) for speed in self.speeds]
        return json.dumps({"checks": [asdict(check) for check in self.checks], "speed": speeds}, indent=1)


def diagnose(job: DoctorJob, on_engine: Callable[[str, float], None] = lambda engine, seconds: None) -> DoctorReport:
    """Check this machine, and measure how fast its engines render.

    Args:
        job: Dataset to plan for.
        on_engine: Called before each measurement with the engine and its measuring time, seconds.

    Raises:
        MeshError: The mesh cannot be loaded.
    """
    if job.mesh is not None:
        load_mesh(job.mesh, units=job.units)
    checks, usable = check_machine(job.out, job.engines)
    chosen = [name for name in job.engines or usable.worth_measuring() if name in usable.names] if job.seconds else []
    speeds = []
    for engine in chosen:
        seconds = job.seconds / len(chosen)
        on_engine(engine, seconds)
        speeds.append(measure_engine(engine, job.config, seconds, job.mesh, job.units))
    return DoctorReport(checks=(*checks, *check_space(speeds, job.n, job.out)), speeds=tuple(speeds), n=job.n)


def check_machine(out: Path, required: Sequence[str]) -> tuple[list[MachineCheck], UsableEngines]:
    """Check this machine; nothing is rendered.

    Args:
        out: Folder of the dataset.
        required: Engines that must work; empty: a missing part that another engine does without is only a warning.

    Returns:
        The checks, and the engines that can run.
    """
    gl, software = _gl()
    blender = _blender(needed=bool({"cycles", "eevee"} & set(required)))
    names = (
        [name for name in ENGINE_NAMES if name == "raster" or blender.state == "ok"] if gl.state != "missing" else []
    )
    checks = [
        MachineCheck(name="python", state="ok", text=f"{platform.python_version()}, {platform.platform()}"),
        MachineCheck(
            name="versions", state="ok", text=", ".join(f"{k} {v}" for k, v in versions(SynthConfig()).items())
        ),
        blender,
        gl,
        _gpus(blender),
        *_resources(out),
    ]
    return checks, UsableEngines(names=tuple(names), software_gl=software)


def check_space(speeds: Sequence[EngineSpeed], n: int, out: Path) -> list[MachineCheck]:
    """A missing requirement for each measured engine whose n pairs exceed the free space at `out`."""
    free = free_bytes(out)
    needed = {s.engine: n * s.measured.bytes_per_pair for s in speeds if s.measured is not None}
    return [
        MachineCheck(
            name="disk space",
            state="missing",
            text=f"{n} pairs of {engine} take {size / _GB:.3g} GB, free at {out} are {free / _GB:.3g} GB",
            remedy="free some space, give another --out, or render fewer pairs",
        )
        for engine, size in needed.items()
        if size > free
    ]


def _blender(needed: bool) -> MachineCheck:
    state: State = "missing" if needed else "warning"
    ok, output = _run_python(_BPY)
    if ok:
        return MachineCheck(name="bpy", state="ok", text=output)
    return MachineCheck(
        name="bpy",
        state=state,
        text=output,
        remedy=_library_remedy(output)
        or "pip install 'bpy>=4.5,<4.6' (needs Python 3.11); --engine raster works without it",
    )


def _gl() -> tuple[MachineCheck, bool]:
    ok, output = _run_python(_GL)
    if not ok:
        remedy = _library_remedy(output) or "install a GPU driver with EGL, or Mesa (Debian: libegl1 libgl1-mesa-dri)"
        return MachineCheck(name="GL", state="missing", text=output, remedy=remedy), False
    device, software = json.loads(output)
    if not software:
        return MachineCheck(
            name="GL", state="ok", text=f"{device}; labels of another driver may differ along edges"
        ), False
    return (
        MachineCheck(
            name="GL",
            state="warning",
            text=f"{device}, software rendering on the CPU: hypotheses, labels, raster and eevee are slower",
            remedy="on a machine with a GPU, install its driver with EGL; keep to one kind within a dataset",
        ),
        True,
    )


def _gpus(blender: MachineCheck) -> MachineCheck:
    if blender.state != "ok":
        return MachineCheck(name="GPUs", state="warning", text="unknown: Blender does not start")
    try:
        gpus = list_gpus()
    except RenderError as error:
        return MachineCheck(name="GPUs", state="warning", text=str(error))
    if not gpus:
        return MachineCheck(name="GPUs", state="ok", text="none that Cycles can use: it traces on the processor")
    listed = ", ".join(f"{count} {kind}" for kind, count in gpus.items())
    return MachineCheck(name="GPUs", state="ok", text=f"{listed}; use --device auto")


def _resources(out: Path) -> list[MachineCheck]:
    here = machine()
    shared = f"{here.shared_bytes / _GB:.3g} GB"
    small = here.shared_bytes <= _SMALL_SHM_BYTES
    return [
        MachineCheck(name="cores", state="ok", text=f"{here.cores:g} of {here.cpu}"),
        MachineCheck(name="memory", state="ok", text=f"{here.memory_bytes / _GB:.3g} GB"),
        MachineCheck(name="disk", state="ok", text=f"{free_bytes(out) / _GB:.4g} GB free at {out}"),
        MachineCheck(
            name="/dev/shm",
            state="warning" if small else "ok",
            text=shared,
            remedy="Blender's pictures pass through it; start the container with --shm-size=1g" if small else "",
        ),
    ]


def _run_python(code: str) -> tuple[bool, str]:
    """Whether Python code succeeds in a process of its own, which may crash, and its last line or its error."""
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
    return False, (run.stderr.strip().splitlines() or ["fails without a message"])[-1]


def _library_remedy(message: str) -> str:
    """Package to install when the loader misses a shared library."""
    missing = re.search(r"(lib[\w+-]+)(\.so[.\d]*): cannot open shared object file", message)
    if missing is None:
        return ""
    name, package = missing.group(1) + missing.group(2), _PACKAGES.get(missing.group(1))
    return (
        f"apt-get install {package}" if package else f"install the package that holds {name} (apt-file search {name})"
    )
