"""Files: bounded reading of untrusted ones, atomic writing, formats."""
