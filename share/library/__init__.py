"""SHARE for Python programs: what `from share import …` gives, over the same runtime as the command line.

    recording       a recording as frames; calibrations
    tracker         frames, or images and IMU samples one by one, to poses
    checked_input   images and samples of a program's own camera
    agent           an agent in threads of this process; a program's own camera as its live camera
    edge            an edge in a thread and processes of this process

docs/lookup/api.md lists the names; docs/do/integrate.md says how to use them.
"""
