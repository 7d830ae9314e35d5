"""Bringing in recorded drives of other formats, as plain drives or in KITTI-360's layout."""
