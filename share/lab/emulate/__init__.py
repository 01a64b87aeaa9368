"""The emulator: sessions of agents in a virtual room (`share emulate`)."""
