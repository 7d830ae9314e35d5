"""The demo drive: an analytic street whose true ranges are known, written in KITTI-360's layout."""
