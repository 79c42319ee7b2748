"""`beamsplat view`: the 3D viewer of the page on saved maps, on splat files and on running systems."""
