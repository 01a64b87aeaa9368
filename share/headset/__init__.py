"""The page of the edge that headsets show: its server, its files, and who may use it (extra headset;
docs/do/headset.md)."""
