"""Headsets that wear a page of the edge: its server, who may use it, and where a headset's own space is in the
map (extra headset; docs/do/headset.md)."""
