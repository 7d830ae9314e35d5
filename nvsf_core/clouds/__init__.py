"""Point cloud files, meshes and registration; the only folder that uses open3d."""
