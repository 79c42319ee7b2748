"""Rasterizers behind one protocol, chosen by name. Torch lives here and nowhere else in the mapper."""
