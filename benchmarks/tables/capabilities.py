"""Gain and lines of code of each part of `lean`: one table in docs/lean.md.

``python -m benchmarks.tables.capabilities`` counts the lines of the code named here and writes the table
between its markers. A part that gives nothing on any drive is deleted, not listed.
"""

import ast
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from benchmarks.common.documents import DOCS, ROOT, markdown_table, write_between

CHAMFER = "Chamfer distance, m²"
F_SCORE = "F-score"
IMAGE_PSNR = "image PSNR, dB"
LPIPS = "LPIPS"
LPIPS_CHANGE = "LPIPS, change"
PSNR_CHANGE = "image PSNR, change, dB"
RANGE_ERROR = "mean range error, m"
SSIM = "SSIM"


@dataclass(frozen=True, slots=True)
class Gain:
    """One figure that was measured without and with a part."""

    metric: str
    """Its name and unit."""
    on: str
    """Drive and view, which of their data, and which piece of the part where it is not all of it."""
    without: str
    """Empty where only the change was written down."""
    with_part: str
    source: str
    """Number of a decision, or any other place where it is written down."""


@dataclass(frozen=True, slots=True)
class Capability:
    """A part of the method that could be left out."""

    name: str
    parts: tuple[str, ...]
    """Below nvsf_core/, what falls away with it: folders, files, or `file:name` of a function or class."""
    gains: tuple[Gain, ...]


CAPABILITIES = (
    Capability(
        "what moves: found, tracked, registered",
        ("evidence/moving", "kernels/bounds.py", "kernels/visibility.py", "kernels/registration.py",
         "kernels/grid_hit_priors.py"),
        (
            Gain(F_SCORE, "`kitti0005`; without: all static. A static scene has none of it",
                 "0.910", "0.944", "a trial before this code"),
        ),
    ),
    Capability(
        "a flow where no rigid motion explains it",
        ("evidence/moving/soft_motion.py",),
        (
            Gain("range error, mm", "`kitti0005`, pedestrian at 7 m, left-out scans", "62", "57", "0016"),
            Gain("range error, mm", "`kitti0005`, pedestrian at 11 m, left-out scans", "59", "54", "0016"),
        ),
    ),
    Capability(
        "range bias and intensity gain of each laser",
        ("sensors/sensor_errors.py",),
        (
            Gain("median range error along rays, m", "`k360_street`, left-out scans",
                 "0.064", "0.038", "commit 5814095"),
            Gain("intensity PSNR, change, dB", "`k360_street`, left-out scans", "", "+0.6", "commit 5814095"),
        ),
    ),
    Capability(
        "scans recorded at a standstill",
        ("evidence/stationary_scans.py", "kernels/stationary_lookup.py"),
        (
            Gain(F_SCORE, "`other_standing`; without: copying, which used to win there",
                 "0.9480", "0.9749", "[results](results.md)"),
        ),
    ),
    Capability(
        "evidence put together, its coarsest voxels chosen by left-out scans",
        ("models/proof.py",),
        (
            Gain(RANGE_ERROR, "an open field, validation scans; voxels of up to 20 cm, of up to 80 cm",
                 "0.125", "0.059", "0059"),
            Gain(RANGE_ERROR,
                 "`kitti0005`, validation scans; voxels of up to 40 cm, of up to 20 cm, which are used",
                 "0.0775", "0.0770", "0059"),
        ),
    ),
    Capability(
        "voxels as small as the returns there allow",
        ("evidence/voxel_sizes.py",),
        (
            Gain(RANGE_ERROR, "`k360_street`, left-out scans, nothing learned", "0.0779", "0.0726", "0059"),
            Gain(RANGE_ERROR, "`kitti0005`, left-out scans, nothing learned", "0.0762", "0.0708", "0059"),
            Gain(RANGE_ERROR, "`street`, left-out scans, nothing learned", "0.0518", "0.0395", "0059"),
            Gain(RANGE_ERROR, "a tunnel, left-out scans, nothing learned", "0.0292", "0.0212", "0059"),
            Gain(RANGE_ERROR, "an open field, left-out scans, nothing learned", "0.0957", "0.0539", "0059"),
        ),
    ),
    Capability(
        "returns that the recording car's bonnet mirrors",
        ("sensors/bonnet.py", "simulation/mirrored.py"),
        (
            Gain(CHAMFER, "`kitti0005`, `quick`, held out", "0.0914", "0.0772", "0032"),
            Gain(CHAMFER, "`k360_street`, `quick`, held out", "0.0269", "0.0237", "0032"),
        ),
    ),
    Capability(
        "rays that meet nothing are copied",
        ("simulation/unmet.py", "models/holdout.py:choose_copied_share"),
        (
            Gain(CHAMFER, "a drive of four lasers, left-out scans", "0.617", "0.269", "0061"),
            Gain(F_SCORE, "a drive of four lasers, left-out scans", "0.7207", "0.8336", "0061"),
            Gain(CHAMFER, "an open field, left-out scans", "0.930", "0.785", "0061"),
        ),
    ),
    Capability(
        "planes that go on from voxel to voxel",
        ("evidence/voxel_planes.py:joined_planes", "kernels/neighbour_moments.py", "kernels/plane_fits.py"),
        (
            Gain(RANGE_ERROR, "`k360_street`, left-out scans, nothing learned", "0.1355", "0.1226", "0056"),
            Gain(RANGE_ERROR, "`kitti0005`, left-out scans, nothing learned", "0.1682", "0.1538", "0056"),
            Gain(RANGE_ERROR, "a generated VLP-16, left-out scans, nothing learned",
                 "0.2033", "0.1748", "0056"),
        ),
    ),
    Capability(
        "the field of rays",
        ("models/residual/lidar.py", "fields/lidar_field.py", "rendering/lidar.py",
         "kernels/composite.py", "kernels/surface_list.py",
         "losses/lidar.py"),
        (
            Gain(CHAMFER, "`k360_street`, held out; without: `reproject`",
                 "0.026", "0.020", "[results](results.md), 698ed4b"),
            Gain("range PSNR, dB", "`k360_street`, held out; without: `reproject`",
                 "29.8", "31.0", "[results](results.md), 698ed4b"),
            Gain("range PSNR, dB", "`kitti0005`, held out; without: `reproject`",
                 "25.0", "26.4", "[results](results.md), 698ed4b"),
        ),
    ),
    Capability(
        "raydrop network on the sensor's own grid",
        ("models/residual/raydrop.py", "models/residual/raydrop_grid.py", "models/residual/cell_step.py",
         "fields/layers.py:CellNetwork", "kernels/scan_lookup.py"),
        (
            Gain("cross-entropy of hits, change, %",
                 "left-out scans, lower on ten of ten; its blend with the ray head fitted, not constant",
                 "", "-0.7 to -3.5", "0015"),
        ),
    ),
    Capability(
        "a pano of its own",
        ("models/residual/pano.py", "models/residual/pano_estimate.py", "models/residual/pano_neighbours.py"),
        (
            Gain("range PSNR, dB", "`k360_street`; two phases of the firings",
                 "29.3", "29.9", "a trial before this code"),
            Gain("hit accuracy", "`k360_street`; the network", "0.969", "0.971", "a trial before this code"),
        ),
    ),
    Capability(
        "camera: learned depths and blend of warped images",
        ("models/residual/camera.py", "models/residual/depth_step.py",
         "models/residual/camera_examples.py", "fields/depth_network.py", "rendering/source_blend.py",
         "kernels/images/blend.py",
         "rendering/plane_depth.py", "rendering/plane_volume.py", "rendering/camera_view.py",
         "rendering/sources.py", "rendering/warping.py",
         "kernels/images/source_lookup.py"),
        (
            Gain(IMAGE_PSNR, "`k360_street`, held out; without: `reproject`",
                 "20.8", "22.0", "[results](results.md), 698ed4b"),
            Gain(IMAGE_PSNR, "`kitti0005`, held out; without: `reproject`",
                 "20.7", "23.6", "[results](results.md), 698ed4b"),
        ),
    ),
    Capability(
        "views by depth maps of the images; pixels that nothing shows are known",
        ("models/residual/image_depths.py", "rendering/view_depth_maps.py",
         "rendering/pixel_support.py", "kernels/images/depth_splat.py"),
        (
            Gain(IMAGE_PSNR, "`street`, `quick`, 3 m aside", "19.8", "23.7", "0022"),
            Gain(IMAGE_PSNR, "`street`, `quick`, turned by 15 degrees", "14.5", "25.5", "0022"),
            Gain(PSNR_CHANGE, "`street`, `quick`, on the path", "", "+0.5 to +0.7", "0022"),
            Gain(IMAGE_PSNR, "`kitti0005`, right camera", "19.9", "20.5", "0022"),
            Gain(IMAGE_PSNR, "`street`, frozen instant; what no source shows asked of other images",
                 "39.9", "40.6", "0042"),
            Gain(IMAGE_PSNR, "`street`, turned by 15 degrees; the same. Left-out images do not change",
                 "26.4", "26.8", "0042"),
            Gain(IMAGE_PSNR, "`street`, turned by 15 degrees; images beyond those around the view",
                 "26.8", "27.0", "0044"),
        ),
    ),
    Capability(
        "depth maps of images at full size",
        ("rendering/sharp_depths.py", "kernels/images/depth_refinement.py", "kernels/images/local_planes.py"),
        (
            Gain(IMAGE_PSNR, "`k360_street`, `quick`, left-out images", "21.3", "21.6", "0039"),
            Gain(IMAGE_PSNR, "`kitti0005`, `quick`, left-out images", "22.5", "22.8", "0039"),
            Gain(IMAGE_PSNR, "`street`, `quick`, left-out images", "27.4", "27.6", "0039"),
        ),
    ),
    Capability(
        "wheels, glass and shadows of what moves, and not what is around it, found by other images",
        ("rendering/object_outlines.py",),
        (
            Gain(IMAGE_PSNR, "`street`, `image_00`, left-out images. A static scene has none of it",
                 "26.6", "26.8", "0041"),
            Gain(IMAGE_PSNR, "`street`, `image_01`, left-out images", "26.6", "26.7", "0041"),
            Gain(IMAGE_PSNR, "`kitti0005`, left-out images", "22.64", "22.72", "0041"),
            Gain(LPIPS, "`kitti0005`, left-out images", "0.089", "0.0875", "0041"),
            Gain(IMAGE_PSNR, "`street`, one camera of three, left-out images; what is around it",
                 "26.85", "26.90", "0043"),
            Gain(IMAGE_PSNR, "`kitti0005`, left-out images; what is around it", "22.86", "22.92", "0043"),
        ),
    ),
    Capability(
        "images of changing exposure are evened",
        ("rendering/image_exposure.py", "models/residual/exposures.py"),
        (
            Gain(IMAGE_PSNR, "`k360_street`, left-out images, aligned. A fixed exposure: nothing to do",
                 "22.10", "22.20", "0040"),
            Gain(LPIPS, "`k360_street`, left-out images, aligned", "0.1005", "0.0977", "0040"),
            Gain(IMAGE_PSNR, "`kitti0005`, left-out images, aligned", "22.80", "22.83", "0040"),
            Gain(LPIPS, "`kitti0005`, left-out images, aligned", "0.106", "0.091", "0040"),
        ),
    ),
    Capability(
        "what sources show is brought together before it is blended",
        ("kernels/images/source_shifts.py", "kernels/images/first_blend.py", "kernels/images/window_mean.py"),
        (
            Gain(IMAGE_PSNR, "`k360_street`, left-out images, aligned", "22.06", "22.15", "0048"),
            Gain(SSIM, "`k360_street`, left-out images, aligned", "0.763", "0.767", "0048"),
            Gain(IMAGE_PSNR, "`kitti0005`, left-out images, aligned", "22.95", "23.08", "0048"),
            Gain(SSIM, "`kitti0005`, left-out images, aligned", "0.739", "0.744", "0048"),
            Gain(LPIPS, "`kitti0005`, left-out images, aligned", "0.087", "0.090", "0048"),
            Gain(PSNR_CHANGE, "`k360_street`, left-out images, aligned; sources read again",
                 "", "-0.011", "0051"),
            Gain(LPIPS_CHANGE, "`k360_street`, left-out images, aligned; sources read again",
                 "", "-0.0010", "0051"),
            Gain(PSNR_CHANGE, "`kitti0005`, left-out images, aligned; sources read again",
                 "", "-0.009", "0051"),
            Gain(LPIPS_CHANGE, "`kitti0005`, left-out images, aligned; sources read again",
                 "", "-0.0014", "0051"),
            Gain(PSNR_CHANGE, "`street`, 2 m left out; sources read again", "", "+0.009", "0051"),
            Gain(LPIPS_CHANGE, "`street`, 2 m left out; sources read again", "", "-0.0016", "0051"),
            Gain(LPIPS, "`street`, `shift_3m`; sharper off the path", "0.1435", "0.1227", "0055"),
            Gain(PSNR_CHANGE, "`street`, `shift_3m`; sharper off the path", "", "-0.3", "0055"),
        ),
    ),
    Capability(
        "a view's depth: single pixels take that of those around them, surfaces lose their noise",
        ("kernels/images/depth_smoothing.py",),
        (
            Gain(IMAGE_PSNR, "`k360_street`, left-out images, aligned; single pixels",
                 "22.20", "22.19", "0050"),
            Gain(SSIM, "`k360_street`, left-out images, aligned; single pixels", "0.769", "0.771", "0050"),
            Gain(LPIPS, "`k360_street`, left-out images, aligned; single pixels", "0.095", "0.093", "0050"),
            Gain(IMAGE_PSNR, "`kitti0005`, left-out images, aligned; single pixels. The rest is the same",
                 "23.02", "23.04", "0050"),
            Gain(LPIPS, "`street`, left-out images, aligned; single pixels", "0.0852", "0.0844", "0050"),
            Gain(PSNR_CHANGE, "left-out images, aligned; smoothed", "", "within 0.005", "0051"),
            Gain(LPIPS_CHANGE, "`k360_street`, left-out images, aligned; smoothed", "", "-0.0008", "0051"),
            Gain(LPIPS_CHANGE, "`kitti0005`, left-out images, aligned; smoothed", "", "0", "0051"),
            Gain(LPIPS_CHANGE, "`street`, 2 m left out; smoothed", "", "-0.0008 to -0.0026", "0051"),
        ),
    ),
    Capability(
        "sources that differ over an area lose weight",
        ("kernels/images/source_agreement.py",),
        (
            Gain(IMAGE_PSNR, "`k360_street`, left-out images, aligned, before training",
                 "22.14", "22.17", "0049"),
            Gain(SSIM, "`k360_street`, left-out images, aligned, before training", "0.767", "0.769", "0049"),
            Gain(IMAGE_PSNR, "`kitti0005`, left-out images, aligned, before training",
                 "23.00", "23.00", "0049"),
            Gain(SSIM, "`kitti0005`, left-out images, aligned, before training", "0.741", "0.745", "0049"),
            Gain(LPIPS,
                 "`kitti0005`, left-out images, aligned, before training; half is by the power of nearness",
                 "0.086", "0.089", "0049"),
        ),
    ),
    Capability(
        "images aligned among each other",
        ("models/residual/pose_refinement.py", "rendering/image_alignment.py"),
        (
            Gain(PSNR_CHANGE, "`k360_street`, left-out images, three seeds",
                 "", "+0.45 to +0.51", "commit 1dd7d0e"),
            Gain(PSNR_CHANGE, "`kitti0005`, left-out images, three seeds",
                 "", "+0.01 to +0.03", "commit 1dd7d0e"),
            Gain(PSNR_CHANGE,
                 "`street`, left-out images, three seeds; its poses are exact, so it is not used there",
                 "", "-0.04 to -0.24", "commit 1dd7d0e"),
        ),
    ),
    Capability(
        "moving objects where they are at the image's instant",
        ("models/residual/dynamic_masks.py",),
        (
            Gain(IMAGE_PSNR, "`kitti0005`, left-out images; together with a loss of structure, which is gone",
                 "21.0", "22.5", ""),
        ),
    ),
    Capability(
        "above the recorded lasers: images",
        ("models/residual/outside_fov.py", "evidence/image_surfels.py"),
        (
            Gain(CHAMFER, "`street`'s `vlp16`, of whose returns a quarter met nothing without it",
                 "1.0", "0.5", "0014"),
        ),
    ),
)  # fmt: skip


def main() -> None:
    """Write the table."""
    write_between(ROOT / "docs/lean.md", "capabilities", table())


def table() -> str:
    """The table in Markdown: a row a figure, with name and lines in a part's first row."""
    head = ["part", "lines", "metric", "measured on", "without", "with", "from"]
    rows = [row for part in CAPABILITIES for row in _rows(part)]
    return markdown_table(head, rows, "|---|---:|---|---|---:|---:|---|")


def _rows(part: Capability) -> Iterator[list[str]]:
    first = [part.name, str(lines_of(part))]
    for gain in part.gains:
        yield [*first, gain.metric, gain.on, gain.without, gain.with_part, _linked(gain.source)]
        first = ["", ""]


def _linked(source: str) -> str:
    """The four digits of a decision as a link to its page; other places as they are."""
    if len(source) != 4:
        return source
    (page,) = (DOCS / "decisions").glob(f"{source}-*.md")
    return f"[{source}](decisions/{page.name})"


def lines_of(part: Capability) -> int:
    """Lines of the part's code.

    Raises:
        FileNotFoundError: A file is not there any more.
        KeyError: A function or class is not in its file any more.
    """
    places = [one.partition(":") for one in part.parts]
    return sum(_lines(ROOT / "nvsf_core" / file, name) for file, _, name in places)


def _lines(path: Path, name: str) -> int:
    """Lines of a folder's modules, of a file, or of one function or class in it."""
    if path.is_dir():
        return sum(_lines(file, "") for file in path.rglob("*.py"))
    if not name:
        return len(path.read_text().splitlines())
    named = {getattr(one, "name", ""): one for one in ast.parse(path.read_text()).body}
    return (named[name].end_lineno or 0) - named[name].lineno + 1


if __name__ == "__main__":
    main()
