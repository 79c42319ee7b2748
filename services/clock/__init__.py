"""The clock service: ticks for live robots."""
