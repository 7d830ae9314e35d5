"""Reading and writing a drive in KITTI-360's layout, and the scene catalogue."""
