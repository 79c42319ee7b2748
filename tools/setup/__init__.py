"""From what is plugged in to a deployment that runs, step by step in a terminal."""
