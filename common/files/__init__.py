"""Crash-safe files (atomic replacement, epoch counters, replay positions) and files of the package."""
