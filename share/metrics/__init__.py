"""Measures of a run: ATE, RPE, local error, latency and the log of frames."""
