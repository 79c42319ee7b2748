"""Planar lidars: their byte protocols, and revolutions with honest times."""
