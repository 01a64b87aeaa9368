"""Do the agents agree with each other? Pairs are compared by their loops; who contradicts is quarantined."""
