"""Reading and writing of drives in KITTI-360's layout."""
