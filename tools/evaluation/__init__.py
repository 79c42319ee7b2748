"""Evaluation of depth and calibration: plays recordings through the libraries of several services."""
