"""SE(3), cameras with their lenses, rigs, absolute pose, interpolation."""
