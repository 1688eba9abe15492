"""Bytes and time of ways to store each field of a pair, and the rate of whole shards streamed in shuffled order.

    python benchmarks/shard_codecs.py --object examples/objects/tug.ply --n 64
    python benchmarks/shard_codecs.py --object examples/objects/tug.ply --n 64 --backgrounds photos/

Pairs are rendered once. Times are process CPU time of one core. The first way of each field
marked * is the one in `data_specs/shard_fields.yaml`; it is measured with the code that writes and reads shards. The
last line is JSON.
"""

import argparse
import json
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numcodecs import blosc, zstd
from posecore.mesh import load_mesh
from posecore.shard import Field, ShardReader, ShardWriter, field_table, sharding_codec
from synthgen.config import load_config
from synthgen.draw.target import make_targets
from synthgen.image.background import list_photos
from synthgen.inputs.assets import Assets
from synthgen.pairs import data_card
from synthgen.pairs.pair_maker import PairMaker, concatenate, limit_threads

Array = np.ndarray
SHARD = 64
BUFFER_SHARDS = 4  # samples are shuffled among so many


@dataclass(frozen=True, kw_only=True)
class Way:
    """A way to store a field: to numbers and back, and those to bytes and back.

    Attributes:
        name: In the table.
        chunk: Samples compressed together.
        encode: Of a chunk of values in the field's unit.
        decode: Bytes to what `encode` was given.
    """

    name: str
    chunk: int
    encode: Callable[[Array], list[bytes]]
    decode: Callable[[list[bytes]], Array]


def render(
    mesh_file: Path, n: int, preset: str, engine: str, backgrounds: Path | None
) -> tuple[dict[str, Array], dict]:
    """Pairs of a preset, and their data card."""
    limit_threads(1)
    meshes = {1: load_mesh(mesh_file, units="mm")}
    config = load_config(preset, (), {"engine": engine})
    assets = Assets(photos=tuple(list_photos(backgrounds)) if backgrounds else ())
    maker = PairMaker(config, make_targets(meshes, config), assets, threads=1)
    per_scene = config.hypotheses_per_scene
    scenes = concatenate(maker.samples(i, per_scene) for i in range(-(-n // per_scene)))
    maker.close()
    card = data_card.rendered_card(config, n, meshes, assets)
    return {name: values[:n] for name, values in scenes.items()}, json.loads(json.dumps(card))


def ours(field: Field, card: dict, codec: str | None = None, chunk: int = sharding_codec.MOST_CHUNK_SAMPLES) -> Way:
    """The shard files' own code, with another codec or chunk length where given."""
    used = codec or field.codec
    rows = chunk if "P" in field.shape else SHARD
    size = field.size(card["patch_px"], card["contour_points"])

    def decode(parts: list[bytes]) -> Array:
        stored = sharding_codec.unpack(parts[0], used, field.dtype, (rows, *size), rows, 0)
        values = np.empty(stored.shape, field.decoded_dtype)
        field.decode(stored, card, values)
        return values

    name = (
        f"{used}, {rows} together"
        if codec or chunk != sharding_codec.MOST_CHUNK_SAMPLES
        else f"* {used}, {rows} together"
    )
    return Way(
        name=name,
        chunk=rows,
        encode=lambda x: [sharding_codec.pack(field.encode(x, card), used, rows, rows)],
        decode=decode,
    )


def scaled(step: float, delta: bool, level: int, dtype: str = "<u2") -> Way:
    """Rounded to steps in 16 bits, Blosc."""
    side: list[int] = []

    def encode(x: Array) -> list[bytes]:
        side[:] = x.shape
        stored = np.rint(x * np.float32(1 / step)).astype(dtype).reshape(-1)
        stored = np.diff(stored, prepend=stored.dtype.type(0)) if delta else stored
        return [blosc.compress(stored, b"zstd", level, blosc.SHUFFLE)]

    def decode(parts: list[bytes]) -> Array:
        stored = np.frombuffer(blosc.decompress(parts[0]), dtype)
        stored = np.cumsum(stored, dtype=dtype) if delta else stored
        return np.multiply(stored, np.float32(step), dtype=np.float32).reshape(-1, *side[1:])

    return Way(name=f"1/{1 / step:g} px{', delta' * delta}, blosc zstd {level}", chunk=8, encode=encode, decode=decode)


def blosc_of(codec: str, level: int, shuffle: int) -> Way:
    """Bytes as they are through Blosc."""
    shape: list[int] = []

    def encode(x: Array) -> list[bytes]:
        shape[:] = x.shape
        return [blosc.compress(np.ascontiguousarray(x).reshape(-1), codec.encode(), level, shuffle)]

    kind = ("no shuffle", "shuffle", "bitshuffle")[shuffle]
    return Way(
        name=f"blosc {codec} {level}, {kind}",
        chunk=8,
        encode=encode,
        decode=lambda parts: np.frombuffer(blosc.decompress(parts[0]), np.uint8).reshape(-1, *shape[1:]),
    )


def zstd_of(level: int) -> Way:
    """Bytes as they are through zstd."""
    shape: list[int] = []

    def encode(x: Array) -> list[bytes]:
        shape[:] = x.shape
        return [zstd.compress(np.ascontiguousarray(x).reshape(-1), level)]

    return Way(
        name=f"zstd {level}",
        chunk=8,
        encode=encode,
        decode=lambda parts: np.frombuffer(zstd.decompress(parts[0]), np.uint8).reshape(-1, *shape[1:]),
    )


def picture(suffix: str, text: str, *options: int) -> Way:
    """Each image in OpenCV's encoder."""

    def encode(x: Array) -> list[bytes]:
        return [cv2.imencode(suffix, image[..., ::-1], options)[1].tobytes() for image in x]

    def decode(parts: list[bytes]) -> Array:
        images = [cv2.imdecode(np.frombuffer(part, np.uint8), cv2.IMREAD_COLOR)[..., ::-1] for part in parts]
        return np.ascontiguousarray(np.stack(images))

    return Way(name=f"{suffix[1:]} {text}", chunk=8, encode=encode, decode=decode)


def jpeg(quality: int) -> Way:
    """JPEG with whole colour."""
    whole = (cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444)
    return picture(".jpg", f"4:4:4 quality {quality}", cv2.IMWRITE_JPEG_QUALITY, quality, *whole)


def ways_of(field: Field, card: dict) -> Iterator[Way]:
    """Candidates; the one in use first."""
    yield ours(field, card)
    if field.name == "scene_rgb":
        yield from (ours(field, card, chunk=n) for n in (1, 16, SHARD))
        yield from (zstd_of(level) for level in (1, 3, 9))
        yield from (blosc_of(codec, 5, shuffle) for codec in ("zstd", "lz4hc", "zlib") for shuffle in (0, 2))
        yield picture(".png", "level 1", cv2.IMWRITE_PNG_COMPRESSION, 1)
        yield picture(".webp", "lossless", cv2.IMWRITE_WEBP_QUALITY, 101)
        yield from (jpeg(quality) for quality in (92, 95, 98))
        yield picture(".webp", "quality 95", cv2.IMWRITE_WEBP_QUALITY, 95)
    elif field.name == "hypothesis_rgb":
        yield from (ours(field, card, "planes+delta+zstd"), zstd_of(3), blosc_of("lz4", 1, 0))
    elif field.squared:
        yield from (ours(field, card, chunk=n) for n in (1, 16, SHARD))
        yield ours(field, card, "shuffle+zstd")
        yield from (scaled(1 / steps, delta, 3) for steps in (128, 32, 16) for delta in (False, True))
    elif field.scale is not None:
        yield from (ours(field, card, chunk=n) for n in (1, SHARD))
        yield ours(field, card, "shuffle+zstd")
    elif field.name.endswith("contour_cam_m"):
        yield ours(field, card, "zstd")


def cpu_ms(work: Callable[[], object], count: int, repeat: int) -> float:
    """Least process CPU time of several runs, per sample."""
    least = float("inf")
    for _ in range(repeat):
        began = time.process_time()
        work()
        least = min(least, time.process_time() - began)
    return 1e3 * least / count


def measure(way: Way, values: Array, repeat: int) -> dict:
    """One line of the table."""
    chunks = [values[i : i + way.chunk] for i in range(0, len(values) - len(values) % way.chunk, way.chunk)]
    n = len(chunks) * way.chunk
    parts = [way.encode(chunk) for chunk in chunks]
    found = np.concatenate([way.decode(part).reshape(chunk.shape) for part, chunk in zip(parts, chunks, strict=True)])
    error = np.abs(found.astype(np.float64) - values[:n])
    line = {
        "way": way.name,
        "bytes": round(sum(len(data) for part in parts for data in part) / n, 1),
        "encode_ms": round(cpu_ms(lambda: [way.encode(chunk) for chunk in chunks], n, repeat), 4),
        "decode_ms": round(cpu_ms(lambda: [way.decode(part) for part in parts], n, repeat), 4),
        "max_error": float(f"{error.max():.3g}"),
    }
    if values.dtype == np.uint8 and error.any():
        line["psnr_db"] = round(float(10 * np.log10(255**2 / np.square(error).mean())), 1)
    return line


def epoch(reader: ShardReader, rng: np.random.Generator) -> int:
    """Every sample once: shards in shuffled order, samples shuffled among several shards. Returns how many."""
    count = 0
    order = rng.permutation(reader.committed)
    buffer: list[dict[str, Array]] = []
    for first in range(0, len(order), BUFFER_SHARDS):
        buffer.clear()
        buffer += [reader.read(int(i)) for i in order[first : first + BUFFER_SHARDS]]
        for place in rng.permutation(len(buffer) * SHARD):
            sample = {name: values[place % SHARD] for name, values in buffer[place // SHARD].items()}
            assert len(sample) == len(field_table())
            count += 1
    return count


def stream(arrays: dict[str, Array], card: dict, shards: int) -> dict:
    """Whole shards of every field, read in shuffled order, their samples shuffled among several shards."""
    rng = np.random.default_rng(0)
    rows = np.arange(SHARD) % len(arrays["obj_id"])
    whole = {name: values[rows] for name, values in arrays.items()}
    with tempfile.TemporaryDirectory() as folder:
        writer = ShardWriter.create(folder + "/shards", {**card, "n": shards * SHARD, "shard_size": SHARD})
        began = time.process_time()
        encoded = [writer.encode(i, whole) for i in range(shards)]
        encode_ms = 1e3 * (time.process_time() - began) / (shards * SHARD)
        for part in encoded:
            writer.commit(part)
        reader = ShardReader(writer.url)
        epoch(reader, rng)  # the memory of the first epoch serves the others
        began, began_cpu = time.perf_counter(), time.process_time()
        count = epoch(reader, rng)
        wall, cpu = time.perf_counter() - began, time.process_time() - began_cpu
    sizes = {name: round(size / SHARD, 1) for name, size in encoded[0].line["bytes"].items()}
    return {
        "bytes_per_pair": round(sum(sizes.values()), 1),
        "bytes": sizes,
        "encode_ms": round(encode_ms, 3),
        "samples_per_s_wall": round(count / wall),
        "samples_per_s_of_cpu": round(count / cpu),
    }


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--object", type=Path, default=Path("examples/objects/tug.ply"), help="mesh, millimetres")
    parser.add_argument("--n", type=int, default=64, help=f"pairs, at least {SHARD}")
    parser.add_argument("--preset", default="default")
    parser.add_argument("--engine", default="raster", choices=["raster", "cycles", "eevee"])
    parser.add_argument("--backgrounds", type=Path, help="folder of photographs; without it they are drawn")
    parser.add_argument("--repeat", type=int, default=3, help="the least time of so many runs counts")
    parser.add_argument("--shards", type=int, default=8, help=f"of {SHARD} pairs, to stream")
    arguments = parser.parse_args()
    if arguments.n < SHARD:
        parser.error(f"--n {arguments.n}: expected at least a shard of {SHARD}")
    blosc.use_threads = False
    arrays, card = render(arguments.object, arguments.n, arguments.preset, arguments.engine, arguments.backgrounds)
    fields: dict[str, list[dict]] = {}
    for field in field_table():
        fields[field.name] = [measure(way, arrays[field.name], arguments.repeat) for way in ways_of(field, card)]
        for line in fields[field.name]:
            psnr = f"  {line['psnr_db']} dB" if "psnr_db" in line else ""
            print(
                f"{field.name:24s} {line['way']:34s} {line['bytes'] / 1e3:8.2f} kB  "
                f"encode {line['encode_ms']:7.3f} ms  decode {line['decode_ms']:6.3f} ms  "
                f"error {line['max_error']:g} {field.unit}{psnr}"
            )
    streamed = stream(arrays, card, arguments.shards)
    print(
        f"streamed: {streamed['bytes_per_pair'] / 1e3:.1f} kB a pair, encode {streamed['encode_ms']} ms, "
        f"{streamed['samples_per_s_wall']} samples/s, {streamed['samples_per_s_of_cpu']} per second of one core"
    )
    facts = {"object": arguments.object.name, "n": arguments.n, "preset": arguments.preset, "engine": arguments.engine}
    photos = None if arguments.backgrounds is None else len(list_photos(arguments.backgrounds))
    print(json.dumps({**facts, "photos": photos, "patch_px": card["patch_px"], "fields": fields, "stream": streamed}))


if __name__ == "__main__":
    main()
