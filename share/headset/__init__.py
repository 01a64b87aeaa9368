"""The page of the edge that headsets show: its server, who may use it, and where a headset's own space is in
the map (extra headset; docs/do/headset.md)."""
