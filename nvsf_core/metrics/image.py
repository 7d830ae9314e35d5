"""Errors of camera images."""

from collections.abc import Mapping

import numpy as np

from nvsf_core.errors import ShapeError
from nvsf_core.metrics.elementwise import psnr, same_shape
from nvsf_core.metrics.lpips import LPIPS_ALEX, Lpips, lpips_measure
from nvsf_core.metrics.measure import Measure, absent, undefined
from nvsf_core.metrics.ssim import ssim

NAMES = ("image_psnr_db", "image_ssim", "image_lpips_squeeze", "image_lpips_alex")
"""Metrics of `image_metrics`."""
MISSING = "image_missing"
"""Metric of `missing_share`."""


def image_metrics(
    predicted_rgb: np.ndarray, truth_rgb: np.ndarray, valid: np.ndarray, lpips: Lpips | None
) -> Mapping[str, Measure]:
    """PSNR (peak 1), SSIM (7x7 uniform, mean of channels) and LPIPS over the recorded image's pixels.

    Images are (H, W, 3) uint8. Pixels that the prediction does not cover are black and count. Pixels that the
    undistorted recording does not cover, not `valid` (H, W) bool, are in no PSNR and no SSIM window, and are
    black on both sides for LPIPS, which is absent if `lpips` is None.

    Raises:
        ShapeError: The shapes differ, or an array is of another type.
    """
    require_images(predicted_rgb, truth_rgb, valid)
    n_valid = int(np.count_nonzero(valid))
    if n_valid == 0:
        return dict.fromkeys(NAMES, undefined("the recorded image has no valid pixel"))
    predicted, truth = predicted_rgb.astype(np.float64) / 255.0, truth_rgb.astype(np.float64) / 255.0
    return {
        "image_psnr_db": Measure(psnr(predicted[valid], truth[valid], 1.0).value, n_valid),
        "image_ssim": ssim(predicted, truth, 1.0, valid),
        "image_lpips_squeeze": lpips_measure(lpips, predicted * valid[..., None], truth * valid[..., None]),
        "image_lpips_alex": LPIPS_ALEX,
    }


def image_part_metrics(
    predicted_rgb: np.ndarray, truth_rgb: np.ndarray, chosen: np.ndarray
) -> Mapping[str, Measure]:
    """PSNR (peak 1) over the `chosen` (H, W) bool pixels of an image (H, W, 3) uint8; absent without one.

    Raises:
        ShapeError: The shapes differ, or an array is of another type.
    """
    require_images(predicted_rgb, truth_rgb, chosen)
    if not chosen.any():
        return {"image_psnr_db": absent("the image has no such pixel")}
    predicted, truth = predicted_rgb[chosen] / 255.0, truth_rgb[chosen] / 255.0
    return {"image_psnr_db": Measure(psnr(predicted, truth, 1.0).value, int(np.count_nonzero(chosen)))}


def missing_share(predicted_rgb: np.ndarray, truth_rgb: np.ndarray, valid: np.ndarray) -> Measure:
    """Share of the pixels that the prediction does not cover: they are black, where the truth is not.

    Args:
        predicted_rgb: (H, W, 3) uint8.
        truth_rgb: (H, W, 3) uint8.
        valid: (H, W) bool, pixels that the truth covers.

    Raises:
        ShapeError: The shapes differ, or an array is of another type.
    """
    require_images(predicted_rgb, truth_rgb, valid)
    seen = valid & truth_rgb.any(axis=-1)
    n_seen = int(np.count_nonzero(seen))
    if n_seen == 0:
        return undefined("the true image has no valid pixel that is not black")
    return Measure(float(np.count_nonzero(~predicted_rgb.any(axis=-1) & seen)) / n_seen, n_seen)


def require_images(predicted_rgb: np.ndarray, truth_rgb: np.ndarray, mask: np.ndarray) -> None:
    """Refuse images that are not (H, W, 3) uint8, and a mask of their pixels that is not (H, W) bool.

    Of colours of 0..1 the metrics would be other numbers; a mask of whole numbers would choose by index.

    Raises:
        ShapeError: One is not so, or the images' shapes differ.
    """
    same_shape(predicted_rgb, truth_rgb)
    for name, image in (("predicted", predicted_rgb), ("true", truth_rgb)):
        if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3:
            raise ShapeError(
                f"expected the {name} image as (H, W, 3) uint8, found {image.shape} {image.dtype}; multiply "
                "colours of 0..1 by 255 and round them"
            )
    if mask.dtype != np.bool_ or mask.shape != truth_rgb.shape[:2]:
        raise ShapeError(
            f"expected a mask {truth_rgb.shape[:2]} bool of the image, found {mask.shape} {mask.dtype}"
        )
