"""Verification of a whole dataset: every shard read, every check measured, one report."""

import hashlib
import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace

import numpy as np
from posecore.errors import ShardError, StorageError
from posecore.processes import behave_as_worker, spawned
from posecore.raster import Rasteriser
from posecore.schema import parse_json
from posecore.shard import ShardReader, n_shards
from posecore.shard.layout import metadata

from synthgen.pairs.pair_maker import limit_threads
from synthgen.verify.check import Check
from synthgen.verify.checks import CHECKS
from synthgen.verify.coverage import Coverage, joined, measure_coverage
from synthgen.verify.facts import Facts, SampleBatch, load_facts
from synthgen.verify.findings import FIRST, Finding, VerificationReport, dataset_finding, tolerance_text

DEFAULT_SAMPLES = 5000


@dataclass(frozen=True, kw_only=True, eq=False)
class ShardResult:
    """Measures of a shard: measure and sample indices by check, or the damage that prevents reading."""

    shard_id: int
    n: int
    damage: str | None = None
    line_is_right: bool = True
    measured: dict[str, tuple[np.ndarray, np.ndarray]] = field(default_factory=dict)
    hashes: tuple[bytes, ...] = ()
    coverage: Coverage = field(default_factory=dict)
    gl: str | None = None


class ShardVerifier:
    """Verifies shards of a dataset, in the thread that made the verifier."""

    def __init__(self, url: str) -> None:
        self.reader = ShardReader(url)
        self.facts = load_facts(self.reader)
        self._lines = self.reader.manifest_lines
        self._rasteriser: Rasteriser | None = None

    def verify(self, shard_id: int, rerendered: Sequence[int]) -> ShardResult:
        """Measure every check; the costly checks only on the samples at the positions `rerendered` of the shard.

        Raises:
            RenderError: Samples are to be rendered and there is no EGL device.
        """
        count = self.reader.n_samples(shard_id)
        try:
            values = self.reader.read(shard_id)
        except (ShardError, StorageError) as error:
            return ShardResult(shard_id=shard_id, n=count, damage=str(error))
        indices = shard_id * self.reader.shard_size + np.arange(count)
        batch = SampleBatch(values, indices, self.facts)
        checks = applicable_checks(self.facts)
        measured = {c.name: (c.measure(batch), indices) for c in checks if not c.rerendered}
        if len(rerendered):
            if self._rasteriser is None:
                self._rasteriser = Rasteriser(self.facts.meshes)
            rows = np.asarray(rerendered)
            part = SampleBatch({k: v[rows] for k, v in values.items()}, indices[rows], self.facts, self._rasteriser)
            measured |= {c.name: (c.measure(part), part.indices) for c in checks if c.rerendered}
        line = self._lines[shard_id]
        return ShardResult(
            shard_id=shard_id,
            n=count,
            line_is_right=line.get("n") == count and line.get("rejected") == int(values["rejected"].sum()),
            measured=measured,
            hashes=tuple(_hash(values, i) for i in range(count)),
            coverage=measure_coverage(batch),
            gl=self._rasteriser.device if self._rasteriser else None,
        )

    def close(self) -> None:
        """Free what was uploaded."""
        if self._rasteriser is not None:
            self._rasteriser.close()
            self._rasteriser = None


def verify(
    url: str,
    *,
    samples: int = DEFAULT_SAMPLES,
    seed: int = 0,
    allow_incomplete: bool = False,
    workers: int = 1,
    on_shard: Callable[[int], None] = lambda n: None,
) -> VerificationReport:
    """Verify a dataset, complete or growing.

    Every shard is read whole. Checks that cost milliseconds a sample are limited to a random choice of samples, whose
    number is in the report.

    Args:
        url: Folder or fsspec URL.
        samples: Number of samples to re-render; all when there are fewer.
        seed: Seed of their choice.
        allow_incomplete: Whether missing shards are allowed.
        workers: Processes. The report does not depend on it.
        on_shard: Called with each shard's number of samples.

    Raises:
        ShardError: Not a dataset of `synthgen render` or `cut`, or nothing is rendered yet.
        RenderError: No EGL device, or a worker process died.
    """
    limit_threads(1)
    verifier = ShardVerifier(url)
    reader, facts = verifier.reader, verifier.facts
    ids = reader.committed
    if not ids:
        raise ShardError(f"{url}: no shard is rendered yet, so there is nothing to verify")
    rerendered = _choose_samples(reader, samples, seed)
    results = []
    with _mapped(verifier, workers, [(i, rerendered.get(i, ())) for i in ids]) as shard_results:
        for result in shard_results:
            results.append(result)
            on_shard(result.n)
    findings = [_complete(reader, allow_incomplete), _arrays(reader), _objects(facts)]
    findings += [*_shards(results), *_samples(results, facts), _duplicates(results, reader.shard_size)]
    return VerificationReport(
        url=url,
        card=dict(facts.card),
        digest=reader.digest,
        committed=sum(map(reader.n_samples, ids)),
        rerendered=sum(map(len, rerendered.values())),
        gl=next((r.gl for r in results if r.gl), None),
        findings=tuple(findings),
        coverage=joined([r.coverage for r in results if r.coverage]),
        facts=facts,
    )


def _choose_samples(reader: ShardReader, samples: int, seed: int) -> dict[int, list[int]]:
    """Positions in their shards of the samples to re-render, by shard."""
    indices = np.concatenate([i * reader.shard_size + np.arange(reader.n_samples(i)) for i in reader.committed])
    if samples < len(indices):
        indices = np.sort(np.random.default_rng(seed).choice(indices, samples, replace=False))
    positions: dict[int, list[int]] = {}
    for index in indices.tolist():
        positions.setdefault(index // reader.shard_size, []).append(index % reader.shard_size)
    return positions


_worker: list[ShardVerifier] = []


def _start_worker(url: str) -> None:
    behave_as_worker()
    limit_threads(1)
    _worker[:] = [ShardVerifier(url)]


def _in_worker(task: tuple[int, Sequence[int]]) -> ShardResult:
    return _worker[0].verify(*task)


@contextmanager
def _mapped(
    verifier: ShardVerifier, workers: int, tasks: Sequence[tuple[int, Sequence[int]]]
) -> Iterator[Iterator[ShardResult]]:
    """Results in the order of the tasks, from this process or from a pool of spawned ones."""
    workers, url = min(workers, len(tasks)), verifier.reader.url
    if workers <= 1 or url.startswith("memory://"):  # that store lives in this process
        try:
            yield (verifier.verify(*task) for task in tasks)
        finally:
            verifier.close()
        return
    died = f"{url}: a worker process died during verification; start again with fewer --workers"
    with spawned(workers, _start_worker, (url,), died) as pool:
        yield pool.map(_in_worker, tasks)


def _complete(reader: ShardReader, allow_incomplete: bool) -> Finding:
    total = n_shards(reader.card)
    missing = sorted(set(range(total)) - set(reader.committed))
    return dataset_finding("complete", "shards", total, [] if allow_incomplete else missing)


def _arrays(reader: ShardReader) -> Finding:
    expected = {key: json.loads(text) for key, text in metadata(reader.card).items()}
    wrong = []
    for key, content in expected.items():
        try:
            right = parse_json(reader.file(key), key, ShardError, "") == content
        except ShardError:
            right = False
        if not right:
            wrong.append(key)
    return dataset_finding("arrays", "files", len(expected), wrong)


def _objects(facts: Facts) -> Finding:
    wrong = [
        obj_id
        for obj_id, mesh in facts.meshes.items()
        if abs(mesh.diameter_m / float(facts.card["objects"][str(obj_id)]["diameter_m"]) - 1) > 1e-5
    ]
    return dataset_finding("objects", "models", len(facts.meshes), wrong)


def _shards(results: Sequence[ShardResult]) -> list[Finding]:
    damaged = [r.shard_id for r in results if r.damage]
    read = [r for r in results if not r.damage]
    lines = [r.shard_id for r in read if not r.line_is_right]
    note = next((r.damage for r in results if r.damage), "")
    return [
        replace(dataset_finding("checksums", "shards", len(results), damaged), note=note),
        dataset_finding("manifest", "shards", len(read), lines),
    ]


def applicable_checks(facts: Facts) -> list[Check]:
    """The checks that apply to this kind of dataset."""
    return [check for check in CHECKS if facts.rendered or not check.rendered]


def _samples(results: Sequence[ShardResult], facts: Facts) -> list[Finding]:
    findings = []
    for check in applicable_checks(facts):
        parts = [r.measured[check.name] for r in results if check.name in r.measured]
        measure = np.concatenate([m for m, _ in parts]) if parts else np.zeros(0)
        indices = np.concatenate([i for _, i in parts]) if parts else np.zeros(0, np.int64)
        measure = np.where(np.isnan(measure), np.inf, measure)
        bad = indices[measure > check.tolerance]
        worst = int(measure.argmax()) if len(measure) else None
        findings.append(
            Finding(
                name=check.name,
                what=check.what,
                covered=len(indices),
                failed=len(bad),
                first=tuple(bad[:FIRST].tolist()),
                worst=None if worst is None or check.unit == "flag" else float(measure[worst]),
                worst_index=None if worst is None else int(indices[worst]),
                tolerance=tolerance_text(check.tolerance, check.unit),
                why=check.why,
            )
        )
    return findings


def _duplicates(results: Sequence[ShardResult], shard_size: int) -> Finding:
    seen: set[bytes] = set()
    twice = []
    for result in results:
        for row, digest in enumerate(result.hashes):
            if digest in seen:
                twice.append(result.shard_id * shard_size + row)
            seen.add(digest)
    return dataset_finding("duplicates", "samples", sum(len(r.hashes) for r in results), twice)


def _hash(values: dict[str, np.ndarray], i: int) -> bytes:
    digest = hashlib.blake2b(digest_size=16)
    for name in ("T_cam_obj", "T_cam_obj_hypothesis", "scene_rgb"):
        digest.update(values[name][i].tobytes())
    return digest.digest()
