"""Commands that look at depth, measure it and calibrate: they play recordings through several services."""
