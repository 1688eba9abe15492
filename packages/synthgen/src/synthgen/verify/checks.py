"""All checks of single samples: the list that the command, the page and the documentation read."""

from synthgen.verify import contour_checks, patch_checks, pose_checks, rerender_checks
from synthgen.verify.check import Check

CHECKS: tuple[Check, ...] = (
    *pose_checks.CHECKS,
    *patch_checks.CHECKS,
    *contour_checks.CHECKS,
    *rerender_checks.CHECKS,
)
"""Every check of a sample, in the order in which they are reported."""
