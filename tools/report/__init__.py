"""Results and costs of a live run: an observer on the bus, scores against ground truth, the HTML report."""
