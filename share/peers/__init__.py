"""Trackers of others, each at the end of a pipe in an interpreter of its own.

`basalt.py` and `orbslam3.py` are scripts: they need their peer's package and numpy, nothing of SHARE, so that
a peer's requirements never meet ours. `peer_wire.py` is what both ends of the pipe use.
"""
