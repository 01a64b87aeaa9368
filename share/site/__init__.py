"""Many rooms behind one address: which room an agent is in, and its change from one to another."""
