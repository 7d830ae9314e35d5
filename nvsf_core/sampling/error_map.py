"""Heuristic sampling (paper): rays are sampled in proportion to a map of each frame's past errors."""

import torch
from torch import Tensor, nn

from nvsf_core.errors import DivergedError, ShapeError
from nvsf_core.numerics import require_finite
from nvsf_core.sampling.patches import require_patch_fits

LIDAR_CELL_PX = 2
"""Side of a cell of the LiDAR's map, in pano pixels."""
CAMERA_CELL_PX = 4
"""Side of a cell of a camera's map, in image pixels."""

_KEPT = 0.1
"""Weight of a cell's old value in an update."""
_LOWEST, _HIGHEST = 1.0, 1000.0
"""Values of a batch's smallest and largest error in the map."""


class ErrorMap(nn.Module):
    """The reconstruction error of each frame on a coarse grid, and samples in proportion to it.

    It is a module so that checkpoints and devices include its state; nothing in it is learned.
    """

    errors: Tensor
    """(frames, ceil(height / cell_px), ceil(width / cell_px)) float32, 1 to 1000."""
    drawable: Tensor
    """(height, width) bool: pixels that may be sampled."""
    _inside: Tensor

    def __init__(
        self, frames: int, height: int, width: int, cell_px: int, is_drawable: Tensor | None = None
    ) -> None:
        """Start with 1 in every cell.

        Args:
            frames: Number of training frames.
            height: Rows of the image.
            width: Columns of the image.
            cell_px: Side of a cell, pixels.
            is_drawable: (height, width) bool, pixels that may be sampled; None = all.

        Raises:
            ShapeError: The mask has another shape, or no pixel.
        """
        super().__init__()
        self.cell_px = cell_px
        cells = (-(-height // cell_px), -(-width // cell_px))
        drawable = torch.ones(height, width, dtype=torch.bool) if is_drawable is None else is_drawable
        if drawable.shape != (height, width) or not bool(drawable.any()):
            raise ShapeError(
                f"error map: expected a mask {(height, width)} that shows something, found "
                f"{tuple(drawable.shape)} with {int(drawable.sum())} pixels"
            )
        self.register_buffer("errors", torch.ones(frames, *cells))
        self.register_buffer("drawable", drawable.clone(), persistent=False)
        padded = torch.zeros(1, 1, cells[0] * cell_px, cells[1] * cell_px)
        padded[0, 0, :height, :width] = drawable
        # (cells, cell_px * cell_px): 1 for the pixels of each cell that may be sampled.
        inside = nn.functional.unfold(padded, cell_px, stride=cell_px)[0].T.contiguous()
        self.register_buffer("_inside", inside, persistent=False)

    @torch.no_grad()
    def update(self, frame: int, rows: Tensor, columns: Tensor, error: Tensor) -> None:
        """Enter the errors (r,) of a frame's batch at pixels (r,), (r,): cell <- 0.1 cell + 0.9 e.

        e is the error, of any unit, mapped linearly from the batch's smallest and largest error to [1, 1000].
        Of several rays in one cell the largest counts (the authors do not say which). A batch without rays,
        or with equal errors only, changes nothing.

        Raises:
            ShapeError: The three differ in length.
            DivergedError: An error is not finite.
        """
        if not rows.shape == columns.shape == error.shape or error.ndim != 1:
            raise ShapeError(
                f"error map: expected rows, columns and errors (r,), found {tuple(rows.shape)}, "
                f"{tuple(columns.shape)}, {tuple(error.shape)}"
            )
        if len(error) == 0:
            return
        error = require_finite(f"error map, errors of frame {frame}", error.to(self.errors))
        low, high = error.min(), error.max()
        # Halved first, or the difference of two huge errors would overflow.
        spread = 0.5 * high - 0.5 * low
        if not bool(spread > 0.0):
            return
        value = _LOWEST + (_HIGHEST - _LOWEST) * ((0.5 * error - 0.5 * low) / spread).clamp(0.0, 1.0)
        cells = self.errors[frame].view(-1)
        cell = rows.to(cells.device) // self.cell_px * self.errors.shape[2]
        cell = cell + columns.to(cells.device) // self.cell_px
        largest = torch.zeros_like(cells).scatter_reduce(0, cell, value, "amax")
        cells.copy_(torch.where(largest > 0.0, _KEPT * cells + (1.0 - _KEPT) * largest, cells))

    def sample_patches(
        self, frame: int, count: int, patch: tuple[int, int], generator: torch.Generator
    ) -> tuple[Tensor, Tensor]:
        """Rows (count,) and columns (count,) of patches' upper left corners, sampled by the frame's errors.

        Cells are sampled by a multinomial without replacement, a corner uniformly within its cell (the
        paper's jitter) and then moved until its patch, of rows and columns, lies within the image. With more
        patches than cells each cell is taken once for every full round.

        Raises:
            ShapeError: The patch is larger than the image.
            DivergedError: The map holds no cell above 0, or one that is not finite.
        """
        height, width = self.drawable.shape
        require_patch_fits((height, width), patch)
        cell_row, cell_column = self._sample_cells(self.errors[frame].flatten(), count, generator)
        jitter = torch.rand(2, count, generator=generator, device=generator.device).to(cell_row.device)
        jitter = (jitter * self.cell_px).long().clamp_max(self.cell_px - 1)
        rows = (cell_row * self.cell_px + jitter[0]).clamp_max(height - patch[0])
        columns = (cell_column * self.cell_px + jitter[1]).clamp_max(width - patch[1])
        return rows, columns

    def sample_pixels(self, frame: int, count: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Rows (count,) and columns (count,) of pixels, sampled by the frame's errors.

        As `sample_patches` with patches of one pixel, uniform over the `drawable` pixels of the cell.

        Raises:
            DivergedError: The map holds no cell above 0, or one that is not finite.
        """
        weights = self.errors[frame].flatten() * (self._inside.sum(dim=1) > 0)
        cell_row, cell_column = self._sample_cells(weights, count, generator)
        if count == 0:
            return cell_row, cell_column
        inside = self._inside[cell_row * self.errors.shape[2] + cell_column].to(generator.device)
        pixel = torch.multinomial(inside, 1, generator=generator)[:, 0].to(cell_row.device)
        rows = cell_row * self.cell_px + pixel // self.cell_px
        return rows, cell_column * self.cell_px + pixel % self.cell_px

    def _sample_cells(self, weights: Tensor, count: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Rows and columns (count,) of cells, sampled without replacement with weights (cells,).

        Raises:
            DivergedError: A weight is not finite, or none is above 0.
        """
        possible = (require_finite("error map, cells to draw from", weights) > 0.0).nonzero()[:, 0]
        if len(possible) == 0:
            raise DivergedError(
                f"error map: expected a cell above 0 to draw from, found none in {len(weights)}; the map of "
                "this frame is no longer what updates leave behind: start without its checkpoint"
            )
        rounds, rest = divmod(count, len(possible))
        parts = [possible] * rounds
        if rest:
            drawn = torch.multinomial(weights.to(generator.device), rest, generator=generator)
            parts.append(drawn.to(possible.device))
        cell = torch.cat([possible[:0], *parts])
        return cell // self.errors.shape[2], cell % self.errors.shape[2]
