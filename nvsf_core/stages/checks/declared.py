"""The checks that the UI and the report show separately: name, condition, reason and limit of each, by stage.

How each is made stands in the other modules of this folder. Importing this one is cheap.
"""

from nvsf_core.clouds.registration import LEAST_ACROSS
from nvsf_core.metrics.norms import LEAST_LEVELS
from nvsf_core.stages.runner.stage import NamedCheck

_RATE_LIMIT = (
    "Limit, from training scans alone: half the way to a scan of which every ray (or none) returns, or as "
    "far as training scans are apart."
)
_SPREAD_LIMIT = (
    "Limit, from training scans alone: half the way to a scan of one intensity, or as far as training scans "
    "are apart."
)

# Sweeps: scans against their poses.
MOST_TURN_DEG = 0.5
"""Largest rotation of a pair; 0.08 degrees at most over 91 pairs of three streets."""
FEWEST_MATCHED = 0.5
"""Least share of matched points; 0.87 at least in those pairs. With fewer the scans do not overlap."""
MOST_OF_MEDIAN = 2.2
"""Measured: at most 1.5 over real streets, 2.9 for scans of none of the neighbouring frames."""
FRAME_CHECK = NamedCheck(
    name="neighbouring_scans_agree_with_their_poses",
    description="Every two neighbouring scans, laid over each other by their poses, are registered (open3d's "
    f"point-to-plane ICP). Value: how far the worst pair moved; it may turn by {MOST_TURN_DEG} degrees, and "
    f"{FEWEST_MATCHED:.0%} of its points must match. More motion means wrong poses or times. Motions that "
    f"slide along all surfaces, as in a tunnel or on a plain (less than {LEAST_ACROSS:.0%} across them), are "
    "named and not counted.",
)
ORDER_CHECK = NamedCheck(
    name="scans_fit_their_own_poses_best",
    description="Each scan is laid over those before and after it, by its own pose and by each of theirs. "
    "Value: the largest mean distance at the own pose over that at the best other; more says that scans were "
    f"swapped. A scan that lies {MOST_OF_MEDIAN:g} times as far off as the median scan fits none of them. "
    "Scans around which no surface fixes the way driven, as along a tunnel, are counted and not blamed.",
)
MOST_TILT_DEG = 15.0
"""Largest angle; 1 degree in streets, 30 where poses are in the frame of a sensor that looks down by 30."""
UPRIGHT_CHECK = NamedCheck(
    name="z_is_up",
    description="The normal of the ground below the LiDAR, in the mean of some scans, against the poses' z "
    "and the LiDAR's. Value: the smaller angle, because on a hill the LiDAR stands as the ground lies; the "
    "larger where over 90 degrees: upside down, or scans whose z points down. More says that poses are in "
    "the frame of a tilted sensor; but heights above ground are taken along z.",
)
MOST_UNLIKE = 3.0
"""Measured: at most 0.4 in real streets, 1.6 on bare ground; from 3.5 for wrong mountings in real streets."""
MOUNTING_CHECK = NamedCheck(
    name="cameras_are_mounted_as_given",
    description="Points of a scan look alike in two images some metres apart (correlation of their grey "
    "values) where the camera's mounting is right. It is also read inverted, turned about z or the optical "
    "axis, and with other axes. Value: how many times as unlike the worst camera's images are as given, of "
    "the best other reading. Where the drive stands, or surfaces look all alike, nothing is found.",
)
SWEEP_CHECKS = (FRAME_CHECK, ORDER_CHECK, UPRIGHT_CHECK, MOUNTING_CHECK)

# Field: a trained model.
WEIGHTS = NamedCheck(
    name="weights_are_finite",
    description="No trained number is NaN or infinite. Value: share that is.",
    blocking=True,
)
LOSS = NamedCheck(
    name="training_lowered_the_loss",
    description="Each part's loss ends no higher than it began, by the medians of the first and the last "
    "fifth of its curve and two standard errors of their difference: single batches differ much. Value: the "
    "worst part's last, less these two, over its first.",
)
RAYS_IN_LIMITS = NamedCheck(
    name="training_scan_is_rendered_within_limits",
    description="Lasers of the middle training scan, rendered by the model just trained, have no NaN, no "
    "range below 0 or beyond the sensor's (and a tenth, for its lever arms), no probability or intensity "
    "outside 0..1. Value: share of the rays that break this.",
    blocking=True,
)
TRAINED_HIT_RATE = NamedCheck(
    name="hit_rate_is_as_trained",
    description="Share of the rays that return in the middle training scan: rendered (without that scan's "
    f"own returns) less recorded. {_RATE_LIMIT}",
)
TRAINED_INTENSITY = NamedCheck(
    name="intensities_are_as_trained",
    description="Earth mover's distance between the intensity histograms of the middle training scan, "
    f"rendered and recorded. {_SPREAD_LIMIT}",
)
FIELD_CHECKS = (WEIGHTS, LOSS, RAYS_IN_LIMITS, TRAINED_HIT_RATE, TRAINED_INTENSITY)

# Novel views: what is rendered.
FINITE = NamedCheck(
    name="stored_views_are_finite",
    description="No number of a rendered view, nor of a baseline's, is NaN or infinite (only the range along "
    "a ray without an answer is). Value: share of the numbers that are.",
    blocking=True,
)
WITHIN = NamedCheck(
    name="stored_views_lie_within_limits",
    description="Returns of the model lie within the sensor's greatest range (and a tenth, for lever arms "
    "and the way driven in a sweep), intensities and hit probabilities in 0..1. Value: share that does not.",
    blocking=True,
)
RETURNS = NamedCheck(
    name="held_out_scans_hold_returns",
    description="Most held-out scans are rendered with returns, where the training scans have them. Value: "
    "share of scans without any where there should be; fewer than half are left to the hit rate to doubt.",
    blocking=True,
)
VIEW_HIT_RATE = NamedCheck(
    name="hit_rate_is_like_the_training_scans",
    description="Share of the rays that return, rendered, less that of the two training scans nearest in "
    f"time: the worst scan of all views by the recording sensor. {_RATE_LIMIT}",
)
VIEW_INTENSITY = NamedCheck(
    name="intensities_are_like_the_training_scans",
    description="Earth mover's distance between the intensity histograms of a rendered scan and of the two "
    f"training scans nearest in time: the worst scan of all views by the recording sensor. {_SPREAD_LIMIT}",
)
BLANK = NamedCheck(
    name="rendered_images_are_not_blank",
    description="A rendered image is blank where its grey values deviate less than half as far from their "
    f"mean as those of its camera's plainest training image, or less than {LEAST_LEVELS:.0f} of 255 levels "
    "(one grey all over then reaches 30 dB), or where no pixel has a finite depth. Value: share of the "
    "images that are.",
)
GREYS = NamedCheck(
    name="images_are_like_the_training_images",
    description="Earth mover's distance between the grey values' histograms of a rendered image and of the "
    "training image of its camera that is most like it: the worst image of all views, as a share of its "
    "camera's limit: half the way to an image of one grey, or as far as its training images are apart.",
)
GHOSTS = NamedCheck(
    name="views_hold_no_ghosts_of_the_recording_vehicle",
    description="The parts of the recording vehicle that its LiDAR sees sweep through space along its path. "
    "Share of a rendered scan's returns that lie there, over 2.5 m from the sensor: the worst scan of all "
    "views. Limit, from training scans alone: twice their largest share, and 5 in 10,000, because "
    "another sensor's returns are spread otherwise.",
)
GUESSED = NamedCheck(
    name="little_of_a_view_is_guessed",
    description="Share of a view's returns, or of a camera's pixels that its lens sees, that are guessed, "
    "where nothing was recorded: the worst. Limit: a tenth; a model trained on such data learns from the "
    "guesses, too.",
)
VIEW_CHECKS = (
    FINITE, WITHIN, RETURNS, VIEW_HIT_RATE, VIEW_INTENSITY, BLANK, GREYS, GHOSTS, GUESSED,
)  # fmt: skip

# Scene metrics: the held-out frames and every view, measured.
DEFINED = NamedCheck(
    name="all_metrics_of_whole_frames_are_finite",
    description="Every metric of a whole held-out frame has a finite value. (Around moving objects, and "
    "where nothing was recorded, none is a finding and no fault; so is an infinite one of a baseline, which "
    "leaves rays without an answer.) Value: how many have not.",
)
IN_RANGE = NamedCheck(
    name="metrics_lie_in_their_ranges",
    description="Shares, F-scores and likenesses lie in 0..1 (SSIM in -1..1), errors are not negative. "
    "Value: how many values lie outside; a metric that does is computed wrongly.",
    blocking=True,
)
BETTER = NamedCheck(
    name="model_is_better_than_copying",
    description="At the held-out frames the model beats the recorded scan and image nearest in time, copied "
    "as they are, in at least half of each sensor's main numbers. Value: share in which it is worse, of the "
    "worst sensor's.",
)
HELD_OUT_HIT_RATE = NamedCheck(
    name="hit_rate_is_as_recorded",
    description="Share of the rays that return in held-out scans: rendered less recorded, the worst scan. "
    f"{_RATE_LIMIT}",
)
HELD_OUT_INTENSITY = NamedCheck(
    name="intensities_are_spread_as_recorded",
    description="Earth mover's distance between the intensity histograms of held-out scans, rendered and "
    f"recorded, the worst scan. {_SPREAD_LIMIT}",
)
TRUSTED = NamedCheck(
    name="views_can_be_trusted",
    description="No view is so far from the recorded data, or so much of it guessed, that it must not be "
    "used. The verdict needs no truth; its limits stand in the report. Value: how many views, by one sensor "
    "each, must not be used.",
)
METRIC_CHECKS = (DEFINED, IN_RANGE, BETTER, HELD_OUT_HIT_RATE, HELD_OUT_INTENSITY, TRUSTED)
