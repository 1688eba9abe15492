"""A sample of a dataset, rendered again and compared with the stored one."""

import io
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np
from posecore.errors import ConfigError, ShardError
from posecore.files import write_atomic
from posecore.mesh import Mesh
from posecore.shard import GROUP, ShardReader, ShardWriter, field_table
from posecore.store import open_store

from synthgen.inspect.preview import sample_row, title_row
from synthgen.pairs.data_card import create_writer
from synthgen.run.render import RenderJob, shard_job
from synthgen.run.shard_job import ShardJob, ShardRenderer

SUFFIXES = (".npz", ".png", ".jpg", ".jpeg")


@dataclass(frozen=True, kw_only=True, eq=False)
class Reproduction:
    """A sample that was rendered again.

    Attributes:
        index: Index of the sample.
        scene: Index of its scene.
        hypothesis: Index of the hypothesis in its scene.
        sample: Every field, as read from a shard.
        meshes: Objects by id.
        differences: Differences from the stored sample, in words; None without a stored sample.
        absent: Reason for no stored sample.
    """

    index: int
    scene: int
    hypothesis: int
    sample: Mapping[str, np.ndarray]
    meshes: Mapping[int, Mesh]
    differences: tuple[str, ...] | None
    absent: str = ""

    @property
    def text(self) -> str:
        """The outcome in one line."""
        name = f"sample {self.index} (scene {self.scene}, hypothesis {self.hypothesis})"
        if self.differences is None:
            return f"{name}: rendered, and not compared: {self.absent}"
        if self.differences:
            return f"{name}: differs from the stored one: {'; '.join(self.differences)}"
        return f"{name}: identical to the stored one"


def reproduce(url: str, job: ShardJob, index: int, *, must_compare: bool = False) -> Reproduction:
    """Render one sample in this process, in its main thread, and compare it with the stored one, bit for bit.

    Args:
        url: Dataset; it need not exist yet.
        job: The dataset's job.
        index: Index of the sample.
        must_compare: Raise an error, before rendering, when the sample is not stored.

    Raises:
        ConfigError: The job has no such sample.
        ShardError: The dataset belongs to another job, the sample's shard is damaged, or the sample is not stored.
        RenderError: A renderer fails.
    """
    n, per_scene = int(job.card["n"]), job.config.hypotheses_per_scene
    if not 0 <= index < n:
        raise ConfigError(f"--only {index}: the dataset has the samples 0 to {n - 1}")
    shard_id, row = divmod(index, job.config.shard_size)
    scene, hypothesis = divmod(index, per_scene)
    stored, absent, quarantined = _stored(url, job, shard_id)
    if stored is None and must_compare:
        raise ShardError(
            f"--only {index}: {absent}, so there is nothing to compare the sample with; start the same command without "
            "--only first, or give --save FILE to look at it"
        )
    renderer = ShardRenderer(job)
    try:
        fields = renderer.scene(shard_id, scene, quarantined)
    finally:
        renderer.close()
    sample = _as_stored(job, {name: values[hypothesis : hypothesis + 1] for name, values in fields.items()})
    different = None
    if stored is not None:
        there = {name: np.asarray(values[row]) for name, values in stored.items()}
        different = tuple(text for name in sample if (text := _difference(name, there[name], sample[name])))
    return Reproduction(
        index=index, scene=scene, hypothesis=hypothesis, sample=sample, meshes=job.meshes, differences=different,
        absent=absent,
    )  # fmt: skip


def save_sample(file: Path, made: Reproduction) -> None:
    """Write a sample's fields (.npz), or its row of a contact sheet (.png, .jpg).

    Raises:
        ConfigError: The file has another suffix.
        StorageError: The file cannot be written.
    """
    check_suffix(file)
    if file.suffix.lower() == ".npz":
        buffer = io.BytesIO()
        np.savez_compressed(buffer, **dict(made.sample))
        write_atomic(file, buffer.getvalue())
        return
    sheet = np.concatenate([title_row(), sample_row(made.sample, made.index, made.meshes)])
    ok, data = cv2.imencode(file.suffix, sheet[..., ::-1])
    assert ok
    write_atomic(file, data.tobytes())


def check_suffix(file: Path) -> None:
    """Refuse a suffix that `save_sample` cannot write."""
    if file.suffix.lower() not in SUFFIXES:
        raise ConfigError(f"--save {file}: expected a file that ends in {', '.join(SUFFIXES)}")


def _stored(url: str, job: ShardJob, shard_id: int) -> tuple[dict[str, np.ndarray] | None, str, frozenset[int]]:
    """The stored shard or the reason for none, and its quarantined scenes."""
    if open_store(url).get(GROUP) is None:
        return None, f"there is no dataset at {url}", frozenset()
    create_writer(url, job.card)  # refuses another dataset as a resumed run does; writes nothing into an existing one
    reader = ShardReader(url)
    if shard_id not in reader.committed:
        return None, f"its shard {shard_id} is not rendered yet", frozenset()
    line = reader.manifest_lines[shard_id]
    return reader.read(shard_id), "", frozenset(line.get("quarantined", ()))


def _as_stored(job: ShardJob, fields: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """A sample as read from a shard: after the same quantisation and codecs."""
    card = {**job.card, "n": 1, "shard_size": 1}
    with TemporaryDirectory() as folder:
        writer = ShardWriter.create(str(Path(folder) / "sample"), card)
        writer.commit(writer.encode(0, fields))
        values = ShardReader(writer.url).read(0)
    return {name: np.asarray(value[0]) for name, value in values.items()}


def _difference(name: str, stored: np.ndarray, made: np.ndarray) -> str:
    """Difference of a field in words, empty for equal bits."""
    if stored.shape == made.shape and stored.dtype == made.dtype and stored.tobytes() == made.tobytes():
        return ""
    if stored.shape != made.shape:
        return f"{name} has the shape {made.shape}, stored is {stored.shape}"
    gap = np.abs(np.asarray(stored, np.float64) - np.asarray(made, np.float64))
    unit = next(field.unit for field in field_table() if field.name == name)
    unit_text = "" if unit in ("1", "bits") else f" {unit}"
    return f"{name} ({int((gap != 0).sum())} of {gap.size} values, by up to {np.nanmax(gap):.4g}{unit_text})"


def reproduce_sample(job: RenderJob, index: int, save: Path | None = None) -> Reproduction:
    """Render one sample of a job again, compare it with the stored one, and save it on request.

    Raises:
        ShardError: Nothing is stored to compare with and nothing is to be saved; or see `reproduce`.
    """
    if save is not None:
        check_suffix(save)
    reproduction = reproduce(job.out, shard_job(job), index, must_compare=save is None)
    if save is not None:
        save_sample(save, reproduction)
    return reproduction
