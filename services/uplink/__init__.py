"""The connection of a robot to its edge server."""
