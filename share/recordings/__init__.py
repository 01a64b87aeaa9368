"""Readers of recordings and sessions, calibration files, trajectories.

A new reader subclasses `recording.Recording`.
"""
