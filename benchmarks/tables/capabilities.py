"""Gain and lines of code of each part of `lean`: one table in docs/lean.md.

``python -m benchmarks.tables.capabilities`` counts the lines of the code named here and writes the table
between its markers. A part that gives nothing on any drive is deleted, not listed.
"""

import ast
from dataclasses import dataclass
from pathlib import Path

from benchmarks.common.documents import ROOT, markdown_table, write_between


@dataclass(frozen=True, slots=True)
class Capability:
    """A part of the method that could be left out."""

    name: str
    parts: tuple[str, ...]
    """Below nvsf_core/, what falls away with it: folders, files, or `file:name` of a function or class."""
    gain: str
    """What was measured with and without it, on which drives, and where that is written down."""


CAPABILITIES = (
    Capability(
        "what moves: found, tracked, registered",
        ("evidence/moving", "kernels/bounds.py", "kernels/visibility.py", "kernels/registration.py",
         "kernels/grid_hit_priors.py"),
        "kitti0005: F of the field .910 to .944 against all static (a trial before this code); a static "
        "scene has none of it",
    ),
    Capability(
        "a flow where no rigid motion explains it",
        ("evidence/moving/soft_motion.py",),
        "kitti0005, pedestrian at 7 m: range error 62 to 57 mm; at 11 m: 59 to 54 mm (decision 0016)",
    ),
    Capability(
        "range bias and intensity gain of each laser",
        ("sensors/sensor_errors.py",),
        "k360_street, left-out scans: raw median .064 to .038 m (5814095), intensity PSNR + .6 dB",
    ),
    Capability(
        "scans recorded at a standstill",
        ("evidence/stationary_scans.py", "kernels/stationary_lookup.py"),
        "other_standing: F .9749; copying, which used to win there, .9480 (docs/results.md)",
    ),
    Capability(
        "evidence put together, its coarsest voxels chosen by left-out scans",
        ("models/proof.py",),
        "validation scans, voxels of up to 80 cm and of up to 20 cm: mean range error of an open field .059 "
        "and .125 m, of kitti0005 .0775 (40 cm) and .0770 m, which is used there (0059)",
    ),
    Capability(
        "voxels as small as the returns there allow",
        ("evidence/voxel_sizes.py",),
        "left-out scans, nothing learned: mean range error .0779 to .0726 m (k360_street), .0762 to .0708 "
        "(kitti0005), .0518 to .0395 (street), .0292 to .0212 (a tunnel), .0957 to .0539 (an open field) "
        "(0059)",
    ),
    Capability(
        "returns that the recording car's bonnet mirrors",
        ("sensors/bonnet.py", "simulation/mirrored.py"),
        "CD .0914 to .0772 (kitti0005), .0269 to .0237 (k360_street), quick (0032)",
    ),
    Capability(
        "unobserved space",
        ("evidence/surfels.py:unobserved_beside", "evidence/surfels.py:_empty_beside"),
        "every 4th scan: CD .0882 to .0856 (kitti0005), .0455 to .0411 (k360_street) (0014)",
    ),
    Capability(
        "planes that go on from voxel to voxel",
        ("evidence/voxel_planes.py:joined_planes", "kernels/neighbour_moments.py", "kernels/plane_fits.py"),
        "left-out scans, nothing learned: mean range error .1355 to .1226 m (k360_street), .1682 to .1538 "
        "(kitti0005), .2033 to .1748 (a generated VLP-16) (0056)",
    ),
    Capability(
        "the field of rays",
        ("models/residual/lidar.py", "fields/lidar_field.py", "rendering/lidar.py",
         "kernels/composite.py", "kernels/surface_list.py",
         "losses/lidar.py"),
        "k360_street: CD .026 (reproject) to .020, range PSNR 29.8 to 31.0 dB; kitti0005: 25.0 to 26.4 dB "
        "(docs/results.md, 698ed4b)",
    ),
    Capability(
        "raydrop network on the sensor's own grid",
        ("models/residual/raydrop.py", "models/residual/raydrop_grid.py", "models/residual/cell_step.py",
         "fields/layers.py:CellNetwork", "kernels/scan_lookup.py"),
        "left-out scans: cross-entropy of hits lower on ten of ten, by .7 to 3.5 % (0015)",
    ),
    Capability(
        "a pano of its own",
        ("models/residual/pano.py", "models/residual/pano_estimate.py", "models/residual/pano_neighbours.py"),
        "k360_street: range PSNR 29.3 to 29.9 dB by its phases, hit .969 to .971 by the network (a trial "
        "before this code)",
    ),
    Capability(
        "camera: learned depths and blend of warped images",
        ("models/residual/camera.py", "models/residual/depth_step.py",
         "models/residual/camera_examples.py", "fields/depth_network.py", "rendering/source_blend.py",
         "kernels/images/blend.py",
         "rendering/plane_depth.py", "rendering/plane_volume.py", "rendering/camera_view.py",
         "rendering/sources.py", "rendering/warping.py",
         "kernels/images/source_lookup.py"),
        "k360_street: 20.8 (reproject) to 22.0 dB; kitti0005: 20.7 to 23.6 (docs/results.md, 698ed4b)",
    ),
    Capability(
        "views by depth maps of the images; pixels that nothing shows are known",
        ("models/residual/image_depths.py", "rendering/view_depth_maps.py",
         "rendering/pixel_support.py", "kernels/images/depth_splat.py"),
        "street, quick, 3 m aside: 19.8 to 23.7 dB, turned by 15 degrees 14.5 to 25.5, on the path + .5 "
        "to .7; kitti0005, right camera: 19.9 to 20.5 (0022). What no source shows asked of other images: "
        "frozen 39.9 to 40.6, turned 26.4 to 26.8, left-out images the same (0042); images beyond those "
        "around: turned 26.8 to 27.0 (0044)",
    ),
    Capability(
        "depth maps of images at full size",
        ("rendering/sharp_depths.py", "kernels/images/depth_refinement.py", "kernels/images/local_planes.py"),
        "left-out images, quick: k360_street 21.3 to 21.6 dB, kitti0005 22.5 to 22.8, street 27.4 to 27.6 "
        "(0039)",
    ),
    Capability(
        "wheels, glass and shadows of what moves, and not what is around it, found by other images",
        ("rendering/object_outlines.py",),
        "left-out images: street 26.6 to 26.8 and 26.7 dB (two cameras of three), kitti0005 22.64 to 22.72, "
        "LPIPS .089 to .0875; a static scene has none of it (0041). What is around it: street 26.85 to 26.90 "
        "in one camera of three, kitti0005 22.86 to 22.92 (0043)",
    ),
    Capability(
        "images of changing exposure are evened",
        ("rendering/image_exposure.py", "models/residual/exposures.py"),
        "left-out images, aligned: k360_street 22.10 to 22.20 dB, LPIPS .1005 to .0977; kitti0005 22.80 to "
        "22.83, .106 to .091; a fixed exposure: nothing to do (0040)",
    ),
    Capability(
        "what sources show is brought together before it is blended",
        ("kernels/images/source_shifts.py", "kernels/images/first_blend.py", "kernels/images/window_mean.py"),
        "left-out images, aligned: k360_street 22.06 to 22.15 dB, SSIM .763 to .767; kitti0005 22.95 to "
        "23.08 dB, .739 to .744, LPIPS .087 to .090 (0048). Read again: - .011, - .009 dB, LPIPS - .0010, "
        "- .0014; street with 2 m left out + .009 dB, - .0016 (0051). Off the path sharper: street's "
        "shift_3m LPIPS .1435 to .1227 for - .3 dB (0055)",
    ),
    Capability(
        "a view's depth: single pixels take that of those around them, surfaces lose their noise",
        ("kernels/images/depth_smoothing.py",),
        "left-out images, aligned: k360_street 22.20 and 22.19 dB, SSIM .769 to .771, LPIPS .095 to .093; "
        "kitti0005 23.02 to 23.04 dB, the rest the same; street .0852 to .0844 (0050). Smoothed: within "
        ".005 dB, LPIPS - .0008, 0 and, street with 2 m left out, - .0008 to - .0026 (0051)",
    ),
    Capability(
        "sources that differ over an area lose weight",
        ("kernels/images/source_agreement.py",),
        "left-out images, aligned, before training: k360_street 22.14 to 22.17 dB, SSIM .767 to .769; "
        "kitti0005 23.00 and 23.00, .741 to .745, LPIPS .086 to .089, half of it by the power of nearness "
        "(0049)",
    ),
    Capability(
        "images aligned among each other",
        ("models/residual/pose_refinement.py", "rendering/image_alignment.py"),
        "left-out images, three seeds, 1dd7d0e: k360_street + .45 to .51 dB, kitti0005 + .01 to .03; street, "
        "whose poses are exact, - .04 to - .24: not used there",
    ),
    Capability(
        "moving objects where they are at the image's instant",
        ("models/residual/dynamic_masks.py",),
        "kitti0005, left-out images: 21.0 to 22.5 dB together with a loss of structure, which is gone",
    ),
    Capability(
        "above the recorded lasers: images",
        ("models/residual/outside_fov.py", "evidence/image_surfels.py"),
        "street's vlp16: CD 1.0 to .5 m2, where a quarter of the returns had no answer (0014)",
    ),
)  # fmt: skip


def main() -> None:
    """Write the table."""
    write_between(ROOT / "docs/lean.md", "capabilities", table())


def table() -> str:
    """The table in Markdown."""
    rows = [[one.name, lines_of(one), one.gain] for one in CAPABILITIES]
    return markdown_table(["part", "lines", "what it gives, held out or left out"], rows, "|---|---:|---|")


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
