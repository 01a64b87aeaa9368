"""Place recognition: candidates by an inverted index, then verification of their geometry."""
