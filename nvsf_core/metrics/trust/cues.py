"""The cues to how far a view can be trusted, without its truth: their names, units and words.

Every cue is larger the farther a view is from recorded data, so that a band has an upper end only.
"""

from dataclasses import dataclass

PROTOCOL = "trust"
"""Protocol of their rows in `scene_metrics`."""
SCORE = "trust_score"
"""What the verdict is made from: of scans the mean of `SCAN_SCORE`, of images the root mean square of
`IMAGE_SCORE`."""
GUESSED = "trust_guessed"
BAND = ("recorded_low", "recorded_median", "recorded_high")
"""Regions of the rows that hold the band of recorded data: its least, median and largest value."""


@dataclass(frozen=True, slots=True)
class Cue:
    """One number about a view that needs no truth."""

    name: str
    """As a metric of `scene_metrics`."""
    unit: str
    title: str
    """Head of a column."""
    reason: str
    """Why a view is doubted in which this cue is the worst one."""


WRONG = Cue(
    "trust_wrong_rays", "1", "rays expected to be wrong",
    "for many of its rays the model itself does not know whether they return",
)  # fmt: skip
AWAY = Cue(
    "trust_away_from_drive", "1", "returns off the recorded surfaces",
    "many of its returns lie where the drive recorded no surface",
)  # fmt: skip
DENSITY = Cue(
    "trust_density_chamfer", "1", "density-aware distance to the drive",
    "its returns lie farther from the recorded ones, or crowd more, than those of a recorded scan",
)  # fmt: skip
MISSING = Cue(
    "trust_returns_missing", "1", "returns missing",
    "it has no returns where the recorded scans near by, seen from its place, have them",
)  # fmt: skip
LASERS = Cue(
    "trust_hits_by_laser", "1", "returns by laser",
    "its lasers return much more or less often than in the recorded scans near by",
)  # fmt: skip
RANGES = Cue(
    "trust_ranges_apart_m", "m", "returns by range",
    "its returns are much nearer or farther than those of the recorded scans near by",
)  # fmt: skip
INCIDENCE = Cue(
    "trust_incidence_apart_deg", "deg", "returns by incidence",
    "its returns meet surfaces at other angles than those of the recorded scans near by",
)  # fmt: skip
INTENSITY = Cue(
    "trust_intensity_apart", "1", "intensity by range and incidence",
    "its returns are brighter or darker than recorded ones of the same range and angle",
)  # fmt: skip
SCAN_PATCHES = Cue(
    "trust_patches_distinguished", "1", "patches distinguished",
    "a small classifier easily distinguishes its patches from recorded ones",
)  # fmt: skip
ODOMETRY = Cue(
    "trust_odometry_m", "m", "error of a step by KISS-ICP",
    "the path that its scans show is not the one that was asked for",
)  # fmt: skip
DISAGREES = Cue(
    "trust_images_disagree", "1", "differs from the nearest image",
    "carried back by its own depth, it does not match the recorded images",
)  # fmt: skip
PARALLAX = Cue(
    "trust_parallax_error", "1", "expected so far from images",
    "it looks at much of the scene from where no recorded image shows it",
)  # fmt: skip
IMAGE_PATCHES = Cue(
    SCAN_PATCHES.name, "1", SCAN_PATCHES.title,
    "a small classifier easily distinguishes its patches from recorded ones: it is more blurred, for example",
)  # fmt: skip
GUESSED_SHARE = Cue(GUESSED, "1", "guessed", "it shows what nobody recorded")

SCAN_SCORE = (WRONG, AWAY, DENSITY)
IMAGE_SCORE = (DISAGREES, PARALLAX)
SCAN_CUES = (*SCAN_SCORE, MISSING, LASERS, RANGES, INCIDENCE, INTENSITY, SCAN_PATCHES, ODOMETRY)
IMAGE_CUES = (*IMAGE_SCORE, IMAGE_PATCHES)
UNITS = {cue.name: cue.unit for cue in (*SCAN_CUES, *IMAGE_CUES, GUESSED_SHARE)} | {SCORE: "1"}
"""Unit of each metric of the protocol."""
