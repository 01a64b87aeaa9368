"""The headset's side of the shared map: where the headset's own space is in it."""
