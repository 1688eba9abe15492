"""An object followed from frame to frame of a sequence."""
