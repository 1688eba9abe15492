"""Result files, their matching with ground truth, and initial poses at known distances from the ground truth."""
