"""The published metrics written once more, from their description alone, in loops and plain numpy.

Nothing here imports the project. Source: LiDAR4D's and NVSF's evaluation as described in words.
"""

import math

import numpy as np
from scipy.spatial import ConvexHull

FAR_M = 80.0


def pano_points(range_m: np.ndarray, fov_up_deg: float, fov_deg: float) -> list[tuple[int, int, np.ndarray]]:
    """Row, column and 3-D point of every filled pixel."""
    height, width = range_m.shape
    found = []
    for j in range(height):
        for i in range(width):
            if range_m[j, i] > 0.0:
                beta = -(i - width / 2.0) / width * 2.0 * math.pi
                alpha = math.radians(fov_up_deg - j / height * fov_deg)
                ray = (math.cos(alpha) * math.cos(beta), math.cos(alpha) * math.sin(beta), math.sin(alpha))
                found.append((j, i, np.array(ray) * float(range_m[j, i])))
    return found


def chamfer_and_f(predicted: np.ndarray, truth: np.ndarray) -> tuple[float, float]:
    """Mean squared distance both ways (m2), and F at squared distance 0.05, by comparing all pairs."""

    def nearest(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        best = np.empty(len(a))
        for start in range(0, len(a), 256):
            gap = a[start : start + 256, None, :] - b[None, :, :]
            best[start : start + 256] = (gap * gap).sum(axis=2).min(axis=1)
        return best

    there, back = nearest(predicted, truth), nearest(truth, predicted)
    precision, recall = float((there < 0.05).mean()), float((back < 0.05).mean())
    f = 0.0 if precision + recall == 0.0 else 2.0 * precision * recall / (precision + recall)
    return float(there.mean() + back.mean()), f


def image_errors(predicted: np.ndarray, truth: np.ndarray, peak: float) -> dict[str, float]:
    """RMSE, MedAE, PSNR of two images over all their pixels, clamped to [1e-6, peak]."""
    p = np.minimum(np.maximum(predicted.astype(np.float64), 1e-6), peak)
    t = np.minimum(np.maximum(truth.astype(np.float64), 1e-6), peak)
    total, errors = 0.0, []
    for a, b in zip(p.ravel().tolist(), t.ravel().tolist(), strict=True):
        total += (a - b) ** 2
        errors.append(abs(a - b))
    errors.sort()
    half = len(errors) // 2
    median = errors[half] if len(errors) % 2 else 0.5 * (errors[half - 1] + errors[half])
    mse = total / len(errors)
    return {"rmse": math.sqrt(mse), "medae": median, "psnr": 10.0 * math.log10(peak**2 / mse)}


def window_ssim(predicted: np.ndarray, truth: np.ndarray, data_range: float) -> float:
    """SSIM over all whole 7x7 windows of one channel: uniform, sample covariance."""
    c1, c2 = (0.01 * data_range) ** 2, (0.03 * data_range) ** 2
    values = []
    for j in range(truth.shape[0] - 6):
        for i in range(truth.shape[1] - 6):
            p = predicted[j : j + 7, i : i + 7].ravel().astype(np.float64)
            t = truth[j : j + 7, i : i + 7].ravel().astype(np.float64)
            mp, mt = p.mean(), t.mean()
            vp, vt = ((p - mp) ** 2).sum() / 48.0, ((t - mt) ** 2).sum() / 48.0
            cov = ((p - mp) * (t - mt)).sum() / 48.0
            top = (2.0 * mp * mt + c1) * (2.0 * cov + c2)
            values.append(top / ((mp * mp + mt * mt + c1) * (vp + vt + c2)))
    return float(np.mean(values))


def ray_drop(probability: np.ndarray, hit: np.ndarray) -> dict[str, float]:
    """RMSE of the probability against 0/1; accuracy and F1 of the class hit at 0.5."""
    square = right = both = claimed = real = 0.0
    for p, h in zip(probability.ravel().tolist(), hit.ravel().tolist(), strict=True):
        said = p > 0.5
        square += (p - (1.0 if h else 0.0)) ** 2
        right += said == bool(h)
        both += said and h
        claimed += said
        real += h
    n = probability.size
    precision, recall = both / claimed, both / real
    return {
        "rmse": math.sqrt(square / n),
        "accuracy": right / n,
        "f": 2.0 * precision * recall / (precision + recall),
    }


def box_corners(box: np.ndarray) -> np.ndarray:
    """(8, 3) corners of a unit cube under a 4x4 transform."""
    corners = []
    for x in (-0.5, 0.5):
        for y in (-0.5, 0.5):
            for z in (-0.5, 0.5):
                corners.append((box @ np.array([x, y, z, 1.0]))[:3])
    return np.array(corners)


def object_mask(
    range_m: np.ndarray, boxes: list[np.ndarray], fov_up_deg: float, fov_deg: float
) -> np.ndarray:
    """Pixels whose own point lies in the convex hull of any box's corners."""
    mask = np.zeros(range_m.shape, dtype=bool)
    hulls = [ConvexHull(box_corners(box)).equations for box in boxes]
    for j, i, point in pano_points(range_m, fov_up_deg, fov_deg):
        mask[j, i] = any((faces[:, :3] @ point + faces[:, 3] <= 1e-9).all() for faces in hulls)
    return mask


def lidar_metrics(
    predicted: tuple[np.ndarray, np.ndarray, np.ndarray],
    truth: tuple[np.ndarray, np.ndarray],
    fov_up_deg: float,
    fov_deg: float,
) -> dict[str, float]:
    """All of a pano pair but LPIPS: predicted range, intensity, hit probability; true range, intensity."""
    range_m, intensity, probability = predicted
    answered = probability > 0.5
    range_m, intensity = range_m * answered, intensity * answered
    cloud = np.array([point for _, _, point in pano_points(range_m, fov_up_deg, fov_deg)])
    real = np.array([point for _, _, point in pano_points(truth[0], fov_up_deg, fov_deg)])
    chamfer, f = chamfer_and_f(cloud, real)
    depth = image_errors(range_m, truth[0], FAR_M)
    light = image_errors(intensity, truth[1], 1.0)
    clamped = [np.clip(side.astype(np.float64), 1e-6, FAR_M) for side in (range_m, truth[0])]
    bright = [np.clip(side.astype(np.float64), 1e-6, 1.0) for side in (intensity, truth[1])]
    drop = ray_drop(probability, truth[0] > 0.0)
    return {
        "chamfer_m2": chamfer, "f_score": f,
        "range_rmse_m": depth["rmse"], "range_medae_m": depth["medae"], "range_psnr_db": depth["psnr"],
        "range_ssim": window_ssim(*clamped, float(clamped[1].max() - clamped[1].min())),
        "intensity_rmse": light["rmse"], "intensity_medae": light["medae"],
        "intensity_psnr_db": light["psnr"],
        "intensity_ssim": window_ssim(*bright, float(bright[1].max() - bright[1].min())),
        "hit_rmse": drop["rmse"], "hit_accuracy": drop["accuracy"], "hit_f_score": drop["f"],
    }  # fmt: skip


def rectangle_mask(
    matrix: np.ndarray, shape: tuple[int, int], boxes_to_camera: list[np.ndarray]
) -> np.ndarray:
    """Union of the bounding rectangles of the boxes that have all 8 corners in front."""
    mask = np.zeros(shape, dtype=bool)
    for box in boxes_to_camera:
        corners = box_corners(box)
        if corners[:, 2].min() <= 0.0:
            continue
        u = [matrix[0, 0] * c[0] / c[2] + matrix[0, 2] for c in corners]
        v = [matrix[1, 1] * c[1] / c[2] + matrix[1, 2] for c in corners]
        for row in range(shape[0]):
            for column in range(shape[1]):
                if min(u) <= column <= max(u) and min(v) <= row <= max(v):
                    mask[row, column] = True
    return mask


def camera_metrics(predicted: np.ndarray, truth: np.ndarray) -> dict[str, float]:
    """PSNR of two 8-bit images with NVSF's 1e-8, SSIM by 7x7 windows, mean of the channels."""
    p, t = predicted / 255.0, truth / 255.0
    channels = [window_ssim(p[..., c], t[..., c], 1.0) for c in range(3)]
    psnr = -10.0 * math.log10(float(((p - t) ** 2).mean()) + 1e-8)
    return {"image_psnr_db": psnr, "image_ssim": float(np.mean(channels))}


def published_depth_rmse(ray_m: np.ndarray, z_m: np.ndarray) -> float:
    """Ray length against z-depth, 0 where there is no LiDAR pixel, over all pixels, capped at 80 m."""
    total = 0.0
    for p, t in zip(ray_m.ravel().tolist(), z_m.ravel().tolist(), strict=True):
        total += ((min(p, FAR_M) if t > 0.0 else 0.0) - min(t, FAR_M)) ** 2
    return math.sqrt(total / ray_m.size)
