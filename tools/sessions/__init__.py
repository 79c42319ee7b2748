"""Editing saved maps: merge, prune, move to new anchors."""
