"""Map files: saved sessions, and exports as splats, point clouds, meshes, nav2 maps, images and videos."""
