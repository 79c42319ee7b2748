"""Engines hold Gaussians on a device, render and optimise them: for the mapper and the camera tracker."""
