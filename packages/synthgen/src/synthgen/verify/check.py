"""A check of single samples, and the list in which a module registers its checks.

A check measures the error of each sample; a sample passes at or below the tolerance. NaN never passes.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from synthgen.verify.facts import SampleBatch

Measure = Callable[[SampleBatch], Float[np.ndarray, " n"]]


@dataclass(frozen=True, kw_only=True, eq=False)
class Check:
    """A property of every sample of a sound dataset.

    Attributes:
        name: Short name, as reported.
        what: The property in one sentence.
        tolerance: Largest measure that passes.
        unit: Unit of measure and tolerance.
        why: Reason for the tolerance.
        rerendered: Whether only the re-rendered samples are checked, because it costs milliseconds each.
        rendered: Whether it holds for rendered pairs alone, whose recipe bounds the poses.
        measure: Error of each sample.
    """

    name: str
    what: str
    tolerance: float
    unit: str
    why: str
    rerendered: bool
    rendered: bool
    measure: Measure


class CheckList(list[Check]):
    """Checks of a module, registered by a decorator."""

    def register(
        self, name: str, tolerance: float, unit: str, why: str, *, rerendered: bool = False, rendered: bool = False
    ) -> Callable[[Measure], Measure]:
        """Decorator that appends a check; the docstring of the measure is the checked property. See `Check`."""

        def append(measure: Measure) -> Measure:
            self.append(
                Check(
                    name=name,
                    what=" ".join((measure.__doc__ or "").split()),
                    tolerance=tolerance,
                    unit=unit,
                    why=why,
                    rerendered=rerendered,
                    rendered=rendered,
                    measure=measure,
                )
            )
            return measure

        return append
