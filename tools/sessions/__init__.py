"""Edit saved maps: merge, prune, move anchors."""
