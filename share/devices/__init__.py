"""A device's readiness (`share doctor`) and its clock (`share sync`)."""
