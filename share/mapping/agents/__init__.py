"""Do the agents agree? Pairs are compared by their loops; an agent that contradicts others is quarantined."""
