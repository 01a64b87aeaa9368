"""Training of the error model (`share train`)."""
