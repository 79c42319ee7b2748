"""Planar lidars: their byte protocols, and revolutions with measured time stamps."""
