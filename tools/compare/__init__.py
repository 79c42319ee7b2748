"""Compare two sessions of one place: what appeared and what vanished, with evidence."""
