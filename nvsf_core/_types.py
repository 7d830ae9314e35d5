"""Shapes as types: aliases used in signatures; checked at run time in tests only."""

import numpy as np
from jaxtyping import Bool, Float, Int
from torch import Tensor

__all__ = ["Array", "Bool", "Float", "Int", "Tensor"]

Array = np.ndarray
