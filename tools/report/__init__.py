"""What a live run cost and produced: an observer on the bus, scores against truth, the HTML report."""
