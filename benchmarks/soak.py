"""Fault injection: a dataset must survive every fault byte for byte.

    python benchmarks/soak.py --out /tmp/soak --kills 20 --minutes 10
    python benchmarks/soak.py --out /tmp/soak --engine cycles --n 96 --kills 6

A first dataset is rendered without faults. Then others of the same settings are rendered while workers and the command
itself are killed with `kill -9` at random, the disk is full, the folder turns read-only, files of the dataset are lost
or truncated, a second command writes into the same folder, and a folder of objects holds one that cannot be loaded.
Each must end with the files of the first, by SHA-256. Disk full and read-only need a tmpfs, so root; otherwise they are
skipped and reported. The last line is JSON; the exit code is 0 when nothing was lost.
"""

import argparse
import hashlib
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import psutil

REPOSITORY = Path(__file__).resolve().parent.parent
OBJECTS = REPOSITORY / "examples" / "objects"
FAULTS = ("kills", "full_disk", "read_only", "damage", "two_at_once", "bad_mesh")
HANG_S = 1800.0  # workers of a killed command that still run then will not end


class Fault(Exception):
    """Something was lost, or a command did not end as it should."""


class Soak:
    """Runs `synthgen render` with the same settings again and again.

    Args:
        arguments: Of the command line.
    """

    def __init__(self, arguments: argparse.Namespace) -> None:
        self.arguments = arguments
        self.out: Path = arguments.out
        self.rng = np.random.default_rng(arguments.seed)
        self.start_s = 1.0
        self.counts = {"worker_kills": 0, "driver_kills": 0, "rounds": 0}
        self.skipped: list[str] = []
        self.processes: list[subprocess.Popen[str]] = []

    def command(self, folder: Path, objects: list[Path] | None = None, *extra: str) -> list[str]:
        """The command that renders into a folder."""
        a = self.arguments
        named = [word for path in objects or a.object for word in ("--object", str(path))]
        settings = [word for assignment in a.set for word in ("--set", assignment)]
        return [
            *(sys.executable, "-m", "synthgen.cli", "render", *named, "--out", str(folder), "--n", str(a.n), "--quiet"),
            *("--engine", a.engine, "--workers", str(a.workers), "--test-images", "0", *settings, *extra),
        ]

    def start(self, folder: Path) -> subprocess.Popen[str]:
        """Start the command in a process group of its own, so that processes that outlive it can be detected."""
        process = subprocess.Popen(self.command(folder), stderr=subprocess.PIPE, text=True, process_group=0)
        self.processes.append(process)
        return process

    def finish(self, command: list[str], expected: int = 0, message: str = "") -> str:
        """Run a command to its end; its standard error.

        Raises:
            Fault: Another exit code, a traceback, or no such message.
        """
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        self.check_exit(done.returncode, done.stderr, expected, message)
        return done.stderr

    def check_exit(self, code: int, stderr: str, expected: int, message: str) -> None:
        """Raise a Fault unless a command ended with this exit code and message."""
        last = stderr.strip().splitlines()[-1] if stderr.strip() else "nothing"
        if code != expected or "Traceback" in stderr or message not in stderr:
            (self.out / "stderr.txt").write_text(stderr)
            raise Fault(f"exit code {code}, expected {expected} with {message!r} and no traceback; last line: {last}")

    def compare(self, folder: Path, name: str) -> None:
        """Raise a Fault unless a folder holds the files of the undisturbed dataset and no others."""
        actual, expected = hashes(folder), hashes(self.out / "undisturbed")
        for key in sorted({*actual, *expected}):
            if actual.get(key) != expected.get(key):
                both = key in actual and key in expected
                defect = "differs" if both else "is missing" if key in expected else "is unexpected"
                raise Fault(f"{name}: {key} {defect}")
        show(f"{name}: {len(actual)} files, identical")
        shutil.rmtree(folder)

    def undisturbed(self) -> None:
        """The dataset to compare with."""
        folder = self.out / "undisturbed"
        began = time.monotonic()
        process = self.start(folder)
        while not (folder / "manifest.jsonl").exists() and process.poll() is None:
            time.sleep(0.01)
        self.start_s = time.monotonic() - began
        self.check_exit(process.wait(), process.communicate()[1], 0, "complete")
        size = sum(p.stat().st_size for p in folder.rglob("*") if p.is_file())
        show(f"undisturbed: {len(hashes(folder))} files, {size / 1e6:.1f} MB, {time.monotonic() - began:.0f} s")

    def kills(self) -> None:
        """`kill -9` of random workers and of the command, until there are enough or the time is up.

        A kill waits for up to twice the time of the command's first shard, so that half of the kills hit the start.
        """
        folder, process, done = self.out / "killed", None, 0
        ends_s = time.monotonic() + 60 * self.arguments.minutes
        while done < self.arguments.kills and time.monotonic() < ends_s:
            process = process or self.start(folder)
            time.sleep(self.rng.uniform(0.0, 2 * self.start_s))
            workers = self.workers_of(process)
            if process.poll() is not None:
                self.check_exit(process.returncode, process.communicate()[1], 0, "complete")
                self.compare(folder, f"after {done} kills")
                self.counts["rounds"] += 1
                process = None
                continue
            if self.rng.random() < self.arguments.driver_fraction:
                show(f"kill -9 of the command, pid {process.pid}")
                process.kill()
                process.communicate()
                self.counts["driver_kills"] += 1
                wait_for_the_end_of(process.pid)
                process = None
            elif workers:
                victim = workers[int(self.rng.integers(len(workers)))]
                show(f"kill -9 of a worker, pid {victim.pid}")
                victim.kill()
                self.counts["worker_kills"] += 1
            done = self.counts["driver_kills"] + self.counts["worker_kills"]
        if done < self.arguments.kills:
            self.skipped.append(f"{self.arguments.kills - done} kills: --minutes was over")
        if process is not None:
            _, stderr = process.communicate()
            self.check_exit(process.returncode, stderr, 0, "complete")
        elif folder.exists():
            self.finish(self.command(folder), message="complete")
        else:  # the last round ended by itself and was compared
            return
        self.compare(folder, f"after {done} kills")
        self.counts["rounds"] += 1

    def workers_of(self, process: subprocess.Popen[str]) -> list[psutil.Process]:
        """Worker processes of a command, waited for; none when it ends before."""
        while process.poll() is None:
            try:
                children = psutil.Process(process.pid).children()
                if workers := [p for p in children if "spawn_main" in " ".join(p.cmdline())]:
                    return workers
            except psutil.Error:  # it ended meanwhile
                pass
            time.sleep(0.05)
        return []

    def full_disk(self) -> None:
        """A disk without room is refused; one that fills up meanwhile stops the command until there is room again."""
        with tmpfs(self.out / "small", 1 << 20) as small:
            if small is None:
                self.skipped.append("disk full: needs root, to mount a tmpfs")
                return
            folder = small / "shards"
            self.finish(self.command(folder), 1, "free some space")
            self.mount("remount", "size=2g", small)
            process = self.start(folder)
            while not (folder / "manifest.jsonl").exists() and process.poll() is None:
                time.sleep(0.01)
            used = shutil.disk_usage(small).used
            self.mount("remount", f"size={used + (64 << 10)}", small)
            _, stderr = process.communicate()
            self.check_exit(process.returncode, stderr, 1, "the disk is full")
            self.mount("remount", "size=2g", small)
            self.finish(self.command(folder), message="complete")
            self.compare(folder, "after a full disk")

    def read_only(self) -> None:
        """The folder turns read-only while the command runs, then writable again."""
        with tmpfs(self.out / "locked", 1 << 30) as locked:
            if locked is None:
                self.skipped.append("read-only folder: needs root, to mount a tmpfs")
                return
            folder = locked / "shards"
            process = self.start(folder)
            while not (folder / "manifest.jsonl").exists() and process.poll() is None:
                time.sleep(0.01)
            while process.poll() is None and not self.mount("remount", "ro", locked):
                time.sleep(0.005)  # busy while a file is open for writing
            _, stderr = process.communicate()
            self.check_exit(process.returncode, stderr, 1, "no permission to write here")
            self.finish(self.command(folder), 1, "no permission to write here")
            self.mount("remount", "rw", locked)
            self.finish(self.command(folder), message="complete")
            self.compare(folder, "after a read-only folder")

    def mount(self, *words: str | Path) -> bool:
        """Change a mount; whether that worked."""
        options, folder = ",".join(str(w) for w in words[:-1]), str(words[-1])
        return subprocess.run(["mount", "-o", options, folder], capture_output=True, check=False).returncode == 0

    def damage(self) -> None:
        """A file of the dataset is lost and another cut off."""
        folder = self.out / "damaged"
        shutil.copytree(self.out / "undisturbed", folder)
        files = sorted(p for p in (folder / "scene_rgb").rglob("*") if p.is_file() and p.name != "zarr.json")
        lost, cut = (files[i] for i in self.rng.choice(len(files), 2, replace=False))
        lost.unlink()
        os.truncate(cut, cut.stat().st_size // 2)
        self.finish(self.command(folder), message="is damaged")
        self.compare(folder, "after damage")

    def two_at_once(self) -> None:
        """A second command in the same folder is refused, and the first one is not affected."""
        folder = self.out / "twice"
        first = self.start(folder)
        self.workers_of(first)
        second = subprocess.run(self.command(folder), capture_output=True, text=True, check=False)
        if first.poll() is None:
            self.check_exit(second.returncode, second.stderr, 1, "another synthgen is rendering into this folder")
        _, stderr = first.communicate()
        self.check_exit(first.returncode, stderr, 0, "complete")
        self.compare(folder, "after two commands at once")

    def bad_mesh(self) -> None:
        """A mesh that cannot be loaded among good ones stops the command before it starts, or is skipped on request."""
        models = self.out / "models"
        models.mkdir()
        for number, mesh in enumerate(self.arguments.object, start=1):
            shutil.copy(mesh, models / f"obj_{number:06d}{mesh.suffix}")
        bad = models / f"obj_{len(self.arguments.object) + 1:06d}.ply"
        bad.write_bytes(self.arguments.object[0].read_bytes()[:2000])  # truncated
        folder = self.out / "with_bad_mesh"
        self.finish(self.command(folder, [models]), 1, bad.name)
        if folder.exists():
            raise Fault("a mesh that cannot be loaded leaves a folder behind")
        stderr = self.finish(self.command(folder, [models], "--skip-bad-objects"), message="complete")
        if bad.name not in stderr:
            raise Fault("--skip-bad-objects does not name the skipped mesh")
        shutil.rmtree(folder)
        show("a mesh that cannot be loaded: named, left out with --skip-bad-objects")

    def run(self) -> dict[str, object]:
        """Run all faults; the facts for the last line."""
        began = time.monotonic()
        try:
            self.undisturbed()
            for fault in self.arguments.faults:
                getattr(self, fault)()
        finally:
            for process in self.processes:
                end(process)
        left = [p for p in self.out.rglob("*.tmp")]
        if left:
            raise Fault(f"{left[0]} is left behind")
        return {
            "identical": True,
            **self.counts,
            "skipped": self.skipped,
            "engine": self.arguments.engine,
            "pairs": self.arguments.n,
            "seconds": round(time.monotonic() - began, 1),
        }


def hashes(folder: Path) -> dict[str, str]:
    """SHA-256 of every file below a folder."""
    files = sorted(p for p in folder.rglob("*") if p.is_file())
    return {p.relative_to(folder).as_posix(): hashlib.sha256(p.read_bytes()).hexdigest() for p in files}


def end(process: subprocess.Popen[str]) -> None:
    """Kill a command that still runs, and its children.

    Python's resource tracker is left to end by itself: it removes the semaphores of the killed.
    """
    if process.poll() is not None:
        return
    for member in psutil.process_iter():
        try:
            if os.getpgid(member.pid) == process.pid and "resource_tracker" not in " ".join(member.cmdline()):
                member.kill()
        except (psutil.Error, OSError):  # it ended meanwhile
            pass
    process.wait()


def wait_for_the_end_of(group: int) -> None:
    """Wait until no process of a group is left: children of a killed command must not outlive it."""
    for _ in range(int(HANG_S / 0.1)):
        try:
            os.killpg(group, 0)
        except ProcessLookupError:
            return
        time.sleep(0.1)
    os.killpg(group, signal.SIGKILL)
    raise Fault(f"workers outlive the command by {HANG_S:.0f} s")


@contextmanager
def tmpfs(folder: Path, size_bytes: int) -> Iterator[Path | None]:
    """A small file system in memory, None where it cannot be mounted."""
    folder.mkdir()
    mounted = ["mount", "-t", "tmpfs", "-o", f"size={size_bytes}", "tmpfs", str(folder)]
    if os.geteuid() != 0 or subprocess.run(mounted, capture_output=True, check=False).returncode != 0:
        yield None
        return
    try:
        yield folder
    finally:
        subprocess.run(["umount", "-l", str(folder)], capture_output=True, check=False)


def show(text: str) -> None:
    """Print a line."""
    print(text, flush=True)


def main() -> int:
    """Run it and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="new or empty folder; removed again when all is well")
    parser.add_argument("--object", type=Path, nargs="+", default=[OBJECTS / "tug.ply", OBJECTS / "bobbin.ply"])
    parser.add_argument("--engine", choices=["raster", "cycles"], default="raster")
    parser.add_argument("--n", type=int, default=2000, help="pairs of a dataset")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument(
        "--driver-fraction", type=float, default=0.3, help="fraction of the kills that hit the command itself"
    )
    parser.add_argument("--minutes", type=float, default=10.0, help="time for the kills")
    parser.add_argument("--faults", nargs="+", choices=FAULTS, default=FAULTS, help="faults to inject")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="as of `synthgen render`")
    arguments = parser.parse_args()
    if arguments.out.exists() and any(arguments.out.iterdir()):
        parser.error(f"--out {arguments.out}: is not empty")
    arguments.out.mkdir(parents=True, exist_ok=True)
    try:
        facts = Soak(arguments).run()
    except Fault as fault:
        show(f"FAULT: {fault}; the folders stay in {arguments.out}")
        show(json.dumps({"identical": False, "fault": str(fault)}))
        return 1
    shutil.rmtree(arguments.out)
    show(json.dumps(facts))
    return 0


if __name__ == "__main__":
    sys.exit(main())
