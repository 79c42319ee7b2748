"""Planar lidars: byte protocols of the devices, and revolutions with measured time stamps."""
