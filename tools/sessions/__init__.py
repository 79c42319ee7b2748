"""Editing of saved maps: merging, pruning, moving anchors."""
