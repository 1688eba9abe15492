"""What a scene shows: everything that is drawn at random, from a seed and a scene's number."""
