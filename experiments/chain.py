"""Chains of commands: each shown as it would be typed, and not done again once it is complete."""

import json
import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent


@dataclass(frozen=True, kw_only=True)
class Step:
    """One command.

    Attributes:
        name: Short and unique; the note of how far it came is kept under it.
        why: One line for the reader.
        command: Program and arguments.
        leaves: What it leaves in the working folder; without it the step is not complete, whatever the note says.
        removes: Files of an earlier command, removed before the step starts anew: its program would keep them.
        inside: Whether it runs in the working folder instead of beside it.
        run: Of a training step: its run folder in the working folder, which `--resume` goes on with after an
            interruption and which is cleared otherwise.
    """

    name: str
    why: str
    command: tuple[str, ...]
    leaves: str
    removes: tuple[str, ...] = ()
    inside: bool = False
    run: str | None = None


def words(line: str) -> tuple[str, ...]:
    """Split a command line as a shell would."""
    return tuple(shlex.split(line))


def quoted(path: Path) -> str:
    """Path as the user would type it."""
    return shlex.quote(shown(path))


def shown(path: Path) -> str:
    """Path as the user would type it: relative to where the script was started, if it lies below."""
    here = Path.cwd()
    return str(path.relative_to(here) if path.is_relative_to(here) else path)


def typed(step: Step, work: Path, command: Sequence[str]) -> str:
    """The line to type for a step's command."""
    return f"{f'cd {quoted(work)} && ' if step.inside else ''}{shlex.join(command)}"


def executable(program: str) -> str:
    """Find a program of the project, first beside the Python that runs this."""
    beside = Path(sys.executable).with_name(program)
    found = str(beside) if beside.is_file() else shutil.which(program)
    if found is None:
        raise SystemExit(f"Error: the command {program} is not installed here; run `make setup`, then this again")
    return found


def run_all(work: Path, everything: Sequence[Step]) -> None:
    """Run the steps that are not complete; a step that ran makes all later ones run again."""
    marks = [work / ".steps" / f"{step.name}.json" for step in everything]
    complete = [
        marked(mark, step, "complete") and (work / step.leaves).exists()
        for mark, step in zip(marks, everything, strict=True)
    ]
    todo = [*complete, False].index(False)
    for step in everything[:todo]:
        say(f"{step.why} Done already.")
    began_all = time.monotonic()
    for number, step in enumerate(everything[todo:], start=todo):
        interrupted = number == todo and marked(marks[number], step, "started")
        for mark in marks[number:]:
            mark.unlink(missing_ok=True)
        write_mark(marks[number], step, "started")
        say(f"\n[{number + 1}/{len(everything)}] {step.why}")
        began = time.monotonic()
        run_step(step, work, interrupted)
        took_s = time.monotonic() - began
        write_mark(marks[number], step, "complete", seconds=round(took_s, 1))
        say(f"  {took_s:.0f} s")
    if todo < len(everything):
        say(f"\nTogether: {(time.monotonic() - began_all) / 60:.1f} min")


def run_step(step: Step, work: Path, interrupted: bool) -> None:
    """Run one command, shown as it would be typed.

    Args:
        step: What to run.
        work: Working folder.
        interrupted: Whether this very command was started before and not completed. Training has to be told so; the
            other commands see it for themselves.
    """
    program, arguments = step.command[0], step.command[1:]
    for name in () if interrupted else step.removes:
        (work / name).unlink(missing_ok=True)
    if step.run is not None:
        if interrupted and (work / step.run / "last.safetensors").is_file():
            arguments = (*arguments, "--resume")
        else:
            shutil.rmtree(work / step.run, ignore_errors=True)
    say(f"  $ {typed(step, work, (program, *arguments))}")
    code = subprocess.run([executable(program), *arguments], cwd=work if step.inside else None).returncode
    if code:
        raise SystemExit(f"Error: {program} {arguments[0]} ended with exit code {code}; the reason stands above")
    if not (work / step.leaves).exists():
        raise SystemExit(f"Error: {program} {arguments[0]} left no {work / step.leaves}; the reason stands above")


def marked(mark: Path, step: Step, state: str) -> bool:
    """Tell whether this very command was left in this state."""
    if not mark.is_file():
        return False
    found = json.loads(mark.read_text(encoding="utf-8"))
    return bool(found["command"] == list(step.command) and found["state"] == state)


def write_mark(mark: Path, step: Step, state: str, **values: float) -> None:
    """Leave a note of how far a step came."""
    mark.parent.mkdir(parents=True, exist_ok=True)
    mark.write_text(json.dumps({"state": state, "command": step.command, **values}), encoding="utf-8")


def seconds_of(work: Path, everything: Sequence[Step]) -> dict[str, float]:
    """How long each complete step took, by its name."""
    marks = {step.name: work / ".steps" / f"{step.name}.json" for step in everything}
    found = {name: json.loads(mark.read_text(encoding="utf-8")) for name, mark in marks.items() if mark.is_file()}
    return {name: float(mark["seconds"]) for name, mark in found.items() if mark["state"] == "complete"}


def say(text: str) -> None:
    """Write a line at once, so that it stands before the output of the command it announces."""
    print(text, flush=True)
