"""Result files, the ground truth they are matched with, and initial poses at known distances from it."""
