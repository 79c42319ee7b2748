"""Time for robots without a recording: a tick a second."""
