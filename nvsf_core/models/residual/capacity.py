"""How large a field a scene needs: from its proven surface and from how far its points lie apart."""

import math
from dataclasses import replace

from nvsf_core.evidence.profile import point_spacing_m, surface_m2
from nvsf_core.evidence.static.surfels import Surfels
from nvsf_core.recipe import FieldSpec

_SPACINGS_A_CELL = 2.5
"""Cells that are finer hold too few returns to learn from."""
_CELLS_AN_ENTRY = 4.0
"""Cells of the finest level on a surface that share an entry."""
_MOST_GROWTH = 1.9
"""Between the cells of neighbouring levels."""
_SMALLEST_LOG2 = 10


def needed_field(most: FieldSpec, surfels: Surfels) -> FieldSpec:
    """The recipe's field where the scene fills it, a smaller one where it does not.

    finest cell = max(recipe's, 2.5 spacings); entries a level = surface / (4 finest cell^2) to the nearest
    power of two, and as many levels as keep cells of neighbouring ones within a factor of 1.9; neither is
    more than the recipe's. Decided by the evidence alone: the same scene gets the same field.

    Args:
        most: The recipe's largest field.
        surfels: Of all returns.
    """
    finest_m = max(most.finest_cell_m, _SPACINGS_A_CELL * point_spacing_m(surfels))
    finest_m = min(finest_m, most.coarsest_cell_m)
    entries = surface_m2(surfels) / (_CELLS_AN_ENTRY * finest_m**2)
    log2_table = max(_SMALLEST_LOG2, round(math.log2(max(1.0, entries))))
    levels = 1 + math.ceil(math.log(most.coarsest_cell_m / finest_m) / math.log(_MOST_GROWTH))
    return replace(
        most,
        finest_cell_m=finest_m,
        log2_table=min(most.log2_table, log2_table),
        levels=min(most.levels, levels),
    )
