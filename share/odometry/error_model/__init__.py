"""The error model: a network that estimates an agent's tracking error at a keyframe."""
