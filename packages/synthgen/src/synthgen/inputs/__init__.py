"""What the command line names, loaded: meshes with their symmetries, photographs, panoramas, occluders."""
