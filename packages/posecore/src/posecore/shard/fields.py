"""The field table: fields of a sample and the quantisation of their values."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from posecore.config import load_yaml
from posecore.errors import ShardError
from posecore.files import data_spec

BIT_OBJECT, BIT_VISIBLE, BIT_FOREGROUND = 1, 2, 4
"""Bits of `scene_mask`: the object's whole silhouette, its visible part, and anything in front of the background."""

_SQUARE_TOLERANCE = 0.05  # float32 squares of roots of whole numbers up to 2**18 miss them by less


@dataclass(frozen=True, kw_only=True)
class Field:
    """One row of the field table.

    Attributes:
        name: Array name in the group; ends in its unit where it has one.
        dtype: On disk.
        shape: Without the sample axis; "P" patch_px, "C" contour_points.
        unit: Of the decoded value.
        codec: Inner codecs, see `posecore.shard.sharding_codec`.
        text: One sentence.
        scale: Decoded value = stored x scale; a name for that entry of the data card; None when stored as it is.
        squared: Stored is the square of the value, a whole number: exact, and float32 when decoded.
    """

    name: str
    dtype: str
    shape: tuple[str | int, ...]
    unit: str
    codec: str
    text: str
    scale: float | str | None = None
    squared: bool = False

    def size(self, patch_px: int, contour_points: int) -> tuple[int, ...]:
        """Shape of a sample's value."""
        symbols = {"P": patch_px, "C": contour_points}
        return tuple(symbols[s] if isinstance(s, str) else s for s in self.shape)

    def step(self, card: Mapping[str, Any]) -> float | None:
        """Value of a step of the stored integer, in `unit`; None when values are stored exactly.

        Raises:
            ShardError: The card lacks the entry that `scale` names.
        """
        if not isinstance(self.scale, str):
            return self.scale
        if self.scale not in card:
            raise ShardError(f"the data card has no {self.scale}, which {self.name} is stored in; render again")
        return float(card[self.scale])

    @property
    def decoded_dtype(self) -> np.dtype:
        """Type of the values that a reader gives."""
        return np.dtype(np.float32) if self.squared or self.scale is not None else np.dtype(self.dtype)

    def encode(self, values: np.ndarray, card: Mapping[str, Any]) -> np.ndarray:
        """Quantise values in `unit`: rounds to the nearest step and refuses values out of range."""
        step = self.step(card)
        if self.squared:
            return self._square(values)
        if step is None:
            exact = np.asarray(values, self.dtype)
            if exact.dtype.kind in "iu" and exact.dtype != np.asarray(values).dtype and (exact != values).any():
                raise ShardError(
                    f"{self.name}: values from {np.min(values)} to {np.max(values)} do not fit {self.dtype}"
                )
            return exact
        stored = np.rint(np.multiply(values, np.float32(1 / step), dtype=np.float32))
        limit = int(np.iinfo(self.dtype).max)
        if not stored.min() >= 0 or not stored.max() <= limit:  # NaN fails both
            raise ShardError(
                f"{self.name}: values from {np.min(values)} to {np.max(values)} {self.unit}, "
                f"expected 0 to {limit * step:g} {self.unit} (what {self.dtype} steps of {step:g} hold)"
            )
        return np.asarray(stored.astype(self.dtype))

    def decode(self, stored: np.ndarray, card: Mapping[str, Any], out: np.ndarray) -> None:
        """Convert stored numbers to values in `unit`, into an array of `decoded_dtype`."""
        step = self.step(card)
        if self.squared:
            np.sqrt(stored, out=out, dtype=np.float32, casting="same_kind")
        elif step is not None:
            np.multiply(stored, np.float32(step), out=out, dtype=np.float32, casting="same_kind")
        else:
            out[...] = stored

    def _square(self, values: np.ndarray) -> np.ndarray:
        square = np.square(values, dtype=np.float32)
        stored = np.rint(square)
        exact = np.abs(square - stored).max() <= _SQUARE_TOLERANCE and stored.max() <= np.iinfo(self.dtype).max
        if not exact or np.min(values) < 0:  # NaN is not exact
            raise ShardError(
                f"{self.name}: values from {np.min(values)} to {np.max(values)} {self.unit}, expected distances "
                "between pixel centres, whose squares are whole numbers"
            )
        return np.asarray(stored.astype(self.dtype))


@cache
def field_table() -> tuple[Field, ...]:
    """The fields of a sample, in the table's order."""
    rows = load_yaml(data_spec("shard_fields.yaml"))["fields"]
    return tuple(Field(name=name, **{**row, "shape": tuple(row["shape"])}) for name, row in rows.items())


@cache
def schema() -> tuple[str, int]:
    """Name and version of the shard schema that this code reads and writes."""
    table = load_yaml(data_spec("shard_fields.yaml"))
    return table["schema"], table["schema_version"]
