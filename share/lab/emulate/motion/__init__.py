"""Motions of agents: simulated walks and robots, recorded ones, and paths that fit into a room."""
