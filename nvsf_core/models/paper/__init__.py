"""The paper's family: one radiance field for LiDAR and camera, and a U-Net for ray drop."""
