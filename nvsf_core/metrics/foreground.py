"""Metrics of moving objects (foreground) and of the rest (background), by annotated boxes.

The boxes are those of the frame itself, at the time of its pose, and for an image at the time when it was
taken. Scans are not compensated for motion: each return is in the sensor's frame at its own firing. Beside
the car, where the firing is up to a quarter of a sweep away from that time, parts of an object may therefore
be outside its box.

`lidar4d` and `image`, as published: each side keeps its own points inside the boxes, and the whole images
are compared, 0 elsewhere. So a predicted point beside the box does not count, and errors shrink with the
object's share of the image. `masked`, which avoids both: recorded returns inside the boxes are compared with
simulated ones inside the boxes enlarged by `GROWN_M`; nothing else is in the mean.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from nvsf_core.geometry.boxes import inside_any
from nvsf_core.metrics.elementwise import psnr, rmse
from nvsf_core.metrics.hit import hit_cell_metrics
from nvsf_core.metrics.image import image_metrics, require_images
from nvsf_core.metrics.lpips import Lpips
from nvsf_core.metrics.measure import Measure, absent
from nvsf_core.metrics.point_cloud import point_cloud_metrics
from nvsf_core.metrics.protocols import (
    MAX_RANGE_M,
    PanoImage,
    RenderedRays,
    Scan,
    lidar4d,
    near_returns,
)
from nvsf_core.metrics.range_and_intensity import clamped_range_m, ray_intensity_metrics, ray_range_metrics
from nvsf_core.metrics.ssim import ssim
from nvsf_core.sensors.linear_pano import LinearPano

FOREGROUND, BACKGROUND = "foreground", "background"
REGIONS = (FOREGROUND, BACKGROUND)
GROWN_M = 0.3
"""How far outside its box a simulated return still counts as the moving object's, metres."""
NO_BOX = "no moving object is annotated in this frame"
NO_RETURN = "no recorded return lies inside a moving object's box"
NO_PIXEL = "no moving object's box lies in front of this camera"


def cut_pano(image: PanoImage, pano: LinearPano, boxes_to_lidar: np.ndarray, region: str) -> PanoImage:
    """A pano with 0 in all pixels whose point is not in the region, `foreground` or `background`.

    Points are those of the pixels with hit > 0.5; other pixels are background. Boxes (B, 4, 4) of moving
    objects lead from the unit cube to the sensor's frame.
    """
    inside = _pixels_inside(_returned_m(image), pano, boxes_to_lidar)
    keep = inside if region == FOREGROUND else ~inside
    return PanoImage(
        range_m=np.where(keep, image.range_m, 0.0),
        intensity=np.where(keep, image.intensity, 0.0),
        hit=np.where(keep, image.hit, 0.0),
    )


def lidar4d_regions(
    predicted: PanoImage,
    truth: PanoImage,
    pano: LinearPano,
    boxes_to_lidar: np.ndarray,
    lpips: Lpips | None,
) -> dict[str, Mapping[str, Measure]]:
    """Foreground and background in the protocols `lidar4d` and `lidar4d_scan`, of one frame, as published.

    One difference: in a frame without a moving object the foreground's metrics are absent (published: 0).

    Args:
        predicted: The model's pano, or the projection of its scan.
        truth: Projection of the recorded scan.
        pano: Their grid.
        boxes_to_lidar: (B, 4, 4) unit cube to the sensor's frame, of the moving objects.
        lpips: The network, or None where its weights are absent.

    Returns:
        Region to metrics over the full pano; the background without LPIPS, which no paper reports.
    """
    found: dict[str, Mapping[str, Measure]] = {}
    for region in REGIONS:
        cut = cut_pano(truth, pano, boxes_to_lidar, region)
        network = lpips if region == FOREGROUND and len(boxes_to_lidar) else None
        measures = lidar4d(cut_pano(predicted, pano, boxes_to_lidar, region), cut, pano, network)
        if region == FOREGROUND and len(boxes_to_lidar) == 0:
            measures = dict.fromkeys(measures, absent(NO_BOX))
        elif not (cut.range_m > 0.0).any():
            # An empty truth is not the prediction's fault.
            measures = {name: absent(NO_RETURN) if m.reason else m for name, m in measures.items()}
        found[region] = measures if region == FOREGROUND else _without_lpips(measures)
    return found


def masked_regions(
    predicted: Scan,
    rendered: RenderedRays,
    truth: Scan,
    truth_rays: RenderedRays,
    hit_shape: tuple[int, int],
    boxes_to_lidar: np.ndarray,
) -> dict[str, Mapping[str, Measure]]:
    """Foreground and background in the protocol `masked`, of one frame, 0 to 80 m on both sides.

    Foreground: Chamfer distance and F-score of recorded returns inside the boxes and simulated ones inside
    the enlarged boxes; range and intensity along the rays of those recorded returns; hits on the cells of
    either (whether the whole scans have a return there). A prediction that puts returns of the road or a wall
    into a box fills more cells, where both sides have returns, so its accuracy rises: read it together with
    the Chamfer distance; `n_valid` counts the cells. Background: both sides outside the enlarged boxes, hits
    on all cells without a return of either side inside the enlarged boxes.

    Args:
        predicted: The exported scan.
        rendered: The prediction along the recorded rays, in the order of the recorded returns.
        truth: The recorded scan.
        truth_rays: Recorded range and intensity along the same rays.
        hit_shape: Lasers and columns of the grid of hits, see `hit_columns`.
        boxes_to_lidar: (B, 4, 4) unit cube to the sensor's frame, of the moving objects.
    """
    shell = inside_any(truth.points_m, boxes_to_lidar, GROWN_M)
    inside = inside_any(truth.points_m, boxes_to_lidar)
    rays = (truth_rays.range_m > 0.0) & (truth_rays.range_m <= MAX_RANGE_M)
    near_predicted, near_truth = near_returns(predicted), near_returns(truth)
    predicted_in = inside_any(near_predicted.points_m, boxes_to_lidar, GROWN_M)
    truth_in = inside_any(near_truth.points_m, boxes_to_lidar)
    truth_shell = inside_any(near_truth.points_m, boxes_to_lidar, GROWN_M)

    def cells(truth_mask: np.ndarray, *, complement: bool) -> Mapping[str, Measure]:
        region = (predicted_in, truth_mask)
        return hit_cell_metrics(
            near_predicted.side, near_truth.side, hit_shape, region=region, complement=complement
        )

    foreground = {
        **_along_rays(rendered, truth_rays, rays & inside),
        **cells(truth_in, complement=False),
        **point_cloud_metrics(near_predicted.points_m[predicted_in], near_truth.points_m[truth_in]),
    }
    if not truth_in.any():
        foreground = dict.fromkeys(foreground, absent(NO_RETURN if len(boxes_to_lidar) else NO_BOX))
    background = {
        **_along_rays(rendered, truth_rays, rays & ~shell),
        **cells(truth_shell, complement=True),
        **point_cloud_metrics(near_predicted.points_m[~predicted_in], near_truth.points_m[~truth_shell]),
    }
    return {FOREGROUND: foreground, BACKGROUND: background}


def masked_range_regions(
    predicted: PanoImage, truth: PanoImage, pano: LinearPano, boxes_to_lidar: np.ndarray
) -> dict[str, Mapping[str, Measure]]:
    """Foreground and background of a range image in the protocol `masked`: `range_rmse_m`, of one frame.

    As in `lidar4d`, the prediction, the model's pano or the projection of its scan, is masked by hit > 0.5,
    both sides are clamped to [1e-6, 80] m, and a pixel that is empty on one side only counts as 0 there.
    Foreground: pixels whose recorded point is in a box (B, 4, 4), unit cube to the sensor's frame, or whose
    simulated point is in an enlarged box. Background: where neither is in an enlarged box.
    """
    predicted_m, truth_m = _returned_m(predicted), truth.range_m
    truth_in = _pixels_inside(truth_m, pano, boxes_to_lidar)
    truth_shell = _pixels_inside(truth_m, pano, boxes_to_lidar, GROWN_M)
    predicted_in = _pixels_inside(predicted_m, pano, boxes_to_lidar, GROWN_M)

    def error(pixels: np.ndarray) -> Mapping[str, Measure]:
        sides = (clamped_range_m(side_m)[pixels] for side_m in (predicted_m, truth_m))
        return {"range_rmse_m": rmse(*sides)}

    foreground = error(truth_in | predicted_in)
    if not truth_in.any():
        foreground = {"range_rmse_m": absent(NO_RETURN if len(boxes_to_lidar) else NO_BOX)}
    return {FOREGROUND: foreground, BACKGROUND: error(~(truth_shell | predicted_in))}


def image_regions(
    predicted_rgb: np.ndarray,
    truth_rgb: np.ndarray,
    valid: np.ndarray,
    rectangles: np.ndarray,
    lpips: Lpips | None,
) -> dict[str, Mapping[str, Measure]]:
    """Foreground and background of a camera in the protocol `image`, as published.

    Both images are black outside the region and compared as a whole; the background without LPIPS.

    Args:
        predicted_rgb: (H, W, 3) uint8.
        truth_rgb: (H, W, 3) uint8.
        valid: (H, W) bool, pixels that the recording covers.
        rectangles: (H, W) bool, pixels inside the boxes' rectangles (`geometry.boxes.box_rectangles`).
        lpips: The network, or None where its weights are absent.
    """
    found: dict[str, Mapping[str, Measure]] = {}
    for region, mask in ((FOREGROUND, rectangles), (BACKGROUND, ~rectangles)):
        kept = mask[..., None].astype(truth_rgb.dtype)
        network = lpips if region == FOREGROUND and mask.any() else None
        measures = image_metrics(predicted_rgb * kept, truth_rgb * kept, valid, network)
        if not mask.any():
            measures = dict.fromkeys(measures, absent(NO_PIXEL))
        found[region] = measures if region == FOREGROUND else _without_lpips(measures)
    return found


def masked_image_regions(
    predicted_rgb: np.ndarray, truth_rgb: np.ndarray, valid: np.ndarray, rectangles: np.ndarray
) -> dict[str, Mapping[str, Measure]]:
    """Foreground and background of a camera in the protocol `masked`: the region's own pixels only.

    PSNR (peak 1) over the valid pixels of the region, SSIM over the 7x7 windows inside them.
    Shapes as in `image_regions`.

    Raises:
        ShapeError: The shapes differ, or an array is of another type.
    """
    require_images(predicted_rgb, truth_rgb, valid)
    predicted, truth = predicted_rgb.astype(np.float64) / 255.0, truth_rgb.astype(np.float64) / 255.0
    found: dict[str, Mapping[str, Measure]] = {}
    for region, mask in ((FOREGROUND, rectangles & valid), (BACKGROUND, ~rectangles & valid)):
        if not mask.any():
            found[region] = dict.fromkeys(("image_psnr_db", "image_ssim"), absent(NO_PIXEL))
            continue
        found[region] = {
            "image_psnr_db": replace(psnr(predicted[mask], truth[mask], 1.0), n_valid=int(mask.sum())),
            "image_ssim": ssim(predicted, truth, 1.0, mask),
        }
    return found


def _returned_m(image: PanoImage) -> np.ndarray:
    """(H, W) range where the hit probability is above 0.5, else 0."""
    return np.where(image.hit > 0.5, image.range_m, 0.0)


def _pixels_inside(
    range_m: np.ndarray, pano: LinearPano, boxes_to_lidar: np.ndarray, grown_m: float = 0.0
) -> np.ndarray:
    """(H, W) bool: pixels whose point lies in a box enlarged by `grown_m`."""
    inside = np.zeros(range_m.shape, dtype=bool)
    inside[range_m > 0.0] = inside_any(pano.points(range_m), boxes_to_lidar, grown_m)
    return inside


def _along_rays(rendered: RenderedRays, truth: RenderedRays, which: np.ndarray) -> dict[str, Measure]:
    returned = np.isfinite(rendered.range_m[which])
    return {
        **ray_range_metrics(rendered.range_m[which], truth.range_m[which]),
        **ray_intensity_metrics(rendered.intensity[which], truth.intensity[which], returned),
    }


def _without_lpips(measures: Mapping[str, Measure]) -> dict[str, Measure]:
    return {name: measure for name, measure in measures.items() if "lpips" not in name}
