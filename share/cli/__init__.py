"""The commands, one file each. `main` has their table, `options` what several share."""
