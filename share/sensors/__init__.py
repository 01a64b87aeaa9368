"""Samples of single sensors: repaired stamps, frames (`sequencer`), profiles of devices."""
