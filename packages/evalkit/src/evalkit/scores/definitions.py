"""Thresholds and definitions of the scores."""

from collections.abc import Mapping

import numpy as np

AUC_LIMIT_M = 0.1
AUC_LIMIT_DIAMETERS = 0.1
RECALL_DIAMETERS = 0.1
"""An ADD(-S) of this many diameters or more is a failure."""
DIVERGED_RAD = np.deg2rad(45.0)
DIVERGED_DIAMETERS = 0.5
ROUNDING_RAD, ROUNDING_M = 1e-7, 1e-8
"""Margin by which a pose perturbed by exactly a limit is neither under nor over it, despite its file's rounding."""

MSSD_DIAMETERS = np.arange(0.05, 0.51, 0.05)
MSPD_PX = np.arange(5.0, 51.0, 5.0)
"""For images 640 pixels wide; an error is scaled by 640 / width first."""
MSPD_WIDTH_PX = 640.0
MSSD_MM = np.arange(2.0, 21.0, 2.0)
VSD_LIMITS = np.arange(0.05, 0.51, 0.05)
BOP24_VISIBLE = 0.1
"""An instance with a smaller visible fraction needs no estimate, and an estimate matched to it is not wrong."""
BOP24_ESTIMATES = 100
"""Number of estimates counted in an image, those with the highest scores."""
RECALL_LEVELS = np.linspace(0.0, 1.0, 101)
"""Recalls at which COCO and BOP24 evaluate the precision."""

DEFINITIONS: Mapping[str, str] = {
    "VSS": "intersection over union of the rendered silhouettes of ground truth and estimate; 0 for a missing estimate",
    "ADD": "average distance of corresponding model points; recall: fraction under 0.1 diameter",
    "ADI": "average distance to the nearest model point (ADD-S); recall: fraction under 0.1 diameter",
    "ADD(-S)": "ADI for objects with symmetries, ADD for the others; recall: fraction under 0.1 diameter",
    "AUC": "area under the recall curve for thresholds from 0 to 100 mm (or to 0.1 diameter where a table has it), "
    "1 at best, as an exact integral; PoseCNN's script sums steps and comes out higher by up to 1 / poses",
    "rotation": "angle between estimated and ground-truth rotation, over found poses; 'sym.' is at the best symmetry",
    "x, y, z": "absolute difference of the object's centre (middle of its bounding box) along the camera's right, down "
    "and forward axes, mm",
    "5 cm 5°": "fraction with a distance of centres under 5 cm and a rotation error (at the best symmetry) under 5°",
    "proj. 5 px": "fraction with an average distance of projected model points (at the best symmetry) under 5 pixels",
    "AR MSSD": "BOP19: mean recall of the maximum surface distance at 0.05, 0.10, ... 0.50 diameter",
    "AR MSPD": "BOP19: mean recall of the maximum projected distance at 5, 10, ... 50 px times image width / 640",
    "AR VSD": "BOP19: mean recall of the visible surface discrepancy under 0.05, 0.10, ... 0.50 with tolerances of "
    "0.05, 0.10, ... 0.50 diameter (10 x 10); only where every image has depth",
    "AR": "BOP19: mean of AR VSD, AR MSSD and AR MSPD",
    "AR without VSD": "mean of AR MSSD and AR MSPD, for data without depth; not to be compared with AR",
    "AP": "BOP24: all estimates and their scores; mean of AP MSSD and AP MSPD, each a mean over objects and over the "
    "ten thresholds of AR, precision read at 101 levels of recall as in COCO; instances visible by less than 0.1 need "
    "no estimate and estimates matched to them are left out, as are estimates of objects that the image does not "
    "contain and all but the 100 best-scored estimates of an image (bop_toolkit's rules)",
    "AP MSSD mm": "BOP25: the same for MSSD under 2, 4, ... 20 mm",
    "BOP matching": "estimates in order of score take the free instance with the smallest error, "
    "for every error and threshold anew; for AR only the inst_count most visible instances and the inst_count best "
    "scored estimates take part",
    "diverged": "fraction with a rotation error (at the best symmetry) over 45 degrees or a distance of centres over "
    "half a diameter; missing ones included",
    "diameter": "the largest distance between two model points, as models_info.json gives it",
    "missing": "an expected pose without an estimate: a failure in every fraction, recall and area, and VSS 0; means "
    "and medians of errors are over found ones",
    "interval": "95 % bootstrap interval, 1000 resamples of whole scenes, or of images where there is one scene only "
    "(of blocks of consecutive images where there are over 2000); percentiles widened for few units (Hesterberg 2015); "
    "none where there are fewer than two",
}
