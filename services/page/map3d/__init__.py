"""The 3D map on the page: heard from the mapper while somebody looks, kept at several levels of detail."""
