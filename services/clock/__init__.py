"""The tick of live robots."""
