"""Log of training metrics: `metrics.jsonl` and TensorBoard events."""

import json
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any

from posecore.files import read_regular, storage_error, write_atomic
from torch.utils.tensorboard import SummaryWriter

from refinenet.models.migration import migrated_metrics


class MetricLog:
    """Appends metrics to `metrics.jsonl` and to TensorBoard event files in one folder.

    Args:
        folder: Folder of the run.
        step: Last step that is kept: later lines, of a run killed after its last checkpoint, are removed.

    Raises:
        StorageError: No rights, no space, or a file stands in the folder's place.
    """

    def __init__(self, folder: Path, step: int) -> None:
        self._path = folder / "metrics.jsonl"
        lines = [line for line in self._lines() if line["step"] <= step]
        write_atomic(self._path, "".join(json.dumps(line) + "\n" for line in lines).encode())
        events = folder / "tensorboard"
        try:
            self._writer = SummaryWriter(str(events), purge_step=step + 1)
        except OSError as error:
            raise storage_error(events, error) from error

    def _lines(self) -> list[dict[str, Any]]:
        if not self._path.is_file():
            return []
        lines: list[dict[str, Any]] = []
        for text in read_regular(self._path).decode("utf-8", "replace").splitlines():
            try:
                line = json.loads(text)
            except (ValueError, RecursionError):  # the line a killed run was writing
                break
            if not isinstance(line, dict) or not isinstance(line.get("step"), int):
                break
            lines.append(migrated_metrics(line))
        return lines

    def write(self, step: int, values: Mapping[str, float]) -> None:
        """One line of metrics of a step; units are in the keys.

        Raises:
            StorageError: No rights or no space any more.
        """
        try:
            with self._path.open("a") as stream:
                stream.write(json.dumps({"step": step, **values}) + "\n")
            for key, value in values.items():
                self._writer.add_scalar(key, value, step)
        except OSError as error:
            raise storage_error(self._path, error) from error

    def __enter__(self) -> "MetricLog":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with suppress(OSError):  # events that a full disk refused; `write` has raised for it
            self._writer.close()
