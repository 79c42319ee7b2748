"""Training of the networks that BeamSplat ships or loads; today the aggregation of the plane sweep."""
