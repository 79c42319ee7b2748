"""Maps as files of others: splats, point clouds, meshes, nav2 maps, pictures."""
