"""Tracking: errors of a tracked pose along a sequence, jitter, and lost frames.

The tables are those of section 4.2 (figure 5) of the 2018 paper, on the sequences of Choi and Christensen ("RGB-D
Object Tracking: A Particle Filter Approach on GPU", IROS 2013): root mean squares of x, y, z in millimetres and of
roll, pitch, yaw in degrees; and the success rate of the RBOT data set (Tjaden et al., "A Region-based Gauss-Newton
Approach to Real-Time Monocular Multiple Object Tracking", TPAMI 2018): the fraction of frames within 5 cm and 5
degrees, where a tracker that fails is reset to the ground truth of that frame.
"""

from evalkit.tracking.job import TrackingJob, make_tracking_table
from evalkit.tracking.reset_run import ResetRun, ResettableTracker, run_with_resets
from evalkit.tracking.residuals import Residuals, changes, euler_deg, residuals
from evalkit.tracking.scores import TRACKING_DEFINITIONS, track_scores
from evalkit.tracking.tables import TrackedFile, axis_table, named_tracks, sequence_table
from evalkit.tracking.tracks import SequenceTrack, frames_of, tracks_of

__all__ = [
    "TRACKING_DEFINITIONS",
    "ResetRun",
    "ResettableTracker",
    "Residuals",
    "SequenceTrack",
    "TrackedFile",
    "TrackingJob",
    "axis_table",
    "changes",
    "euler_deg",
    "frames_of",
    "make_tracking_table",
    "named_tracks",
    "residuals",
    "run_with_resets",
    "sequence_table",
    "track_scores",
    "tracks_of",
]
