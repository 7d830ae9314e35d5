"""Point cloud files, and open3d's one room."""
