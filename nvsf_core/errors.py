"""All errors of the project, in one tree.

NvsfError
├── DataError                input data is wrong; the message names scene, path and remedy
│   ├── CatalogueError       a catalogue cannot be read, or contradicts itself
│   ├── NoDataError          the drive is not on this machine
│   ├── MissingFrameError    a requested frame cannot be used
│   └── CalibrationError     a calibration file lacks a value, or one is invalid
├── ShapeError               an array has another shape or type than its contract says
├── RecipeError              a recipe is unknown, has a wrong value, or contradicts itself
├── StoreError               an output is absent, half-written, or not what its schema says
├── CheckFailedError         a blocking check of a stage failed
├── StageKilledError         the process of a stage died
├── MissingLibraryError      a library or a system library is absent: the message names the package
└── DivergedError            training produced a non-finite number: step, loss term, tensor
"""

__all__ = [
    "CalibrationError",
    "CatalogueError",
    "CheckFailedError",
    "DataError",
    "DivergedError",
    "MissingFrameError",
    "MissingLibraryError",
    "NoDataError",
    "NvsfError",
    "RecipeError",
    "ShapeError",
    "StageKilledError",
    "StoreError",
]


class NvsfError(Exception):
    """Base of every error that this project raises on purpose."""


class DataError(NvsfError):
    """Input data is wrong; the message says what was expected, what was found, where, and what to do."""


class CatalogueError(DataError):
    """A catalogue cannot be read or contradicts itself, perhaps because somebody is editing it."""


class NoDataError(DataError):
    """The files of a catalogued scene are not on this machine."""


class MissingFrameError(DataError):
    """A requested frame does not exist or is invalid."""


class CalibrationError(DataError):
    """A calibration file is absent, lacks a key, or holds a value that is not a number."""


class ShapeError(NvsfError):
    """An array has another shape or type than its contract says."""


class RecipeError(NvsfError):
    """A recipe is unknown, has a value of the wrong type or out of bounds, or contradicts itself."""


class StoreError(NvsfError):
    """A stored output is absent, incomplete, or does not match its schema."""


class CheckFailedError(NvsfError):
    """A blocking check of a stage failed, so its output was not published."""


class StageKilledError(NvsfError):
    """The process that ran a stage was killed or crashed, again and again."""


class MissingLibraryError(NvsfError):
    """A library or system library is missing; the message names the package that brings it."""


class DivergedError(NvsfError):
    """Training met a non-finite number; the message names the step, the loss term and the tensor."""
