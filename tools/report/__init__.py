"""Scores and costs of a live run: observer of the bus, comparison with ground truth, HTML report."""
