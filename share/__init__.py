"""SHARE: user-centric collaborative SLAM for people in AR headsets and robots in one room."""

__version__ = "0.2.0"
