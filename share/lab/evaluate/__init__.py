"""Evaluation: play sessions, score them, compare policies, settings and trackers (`share evaluate`)."""
