"""Localization by the camera alone: render-and-compare tracking against a map of Gaussians of its own."""
