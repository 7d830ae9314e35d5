"""Inner loops over plain arrays, compiled by numba (CPU) or Triton (CUDA); torch versions check them."""

import os

# Before numba is imported. Its own order begins with TBB and warns where one is loaded that is too old,
# as open3d's own is. With OpenMP first nobody looks for TBB.
# OpenMP bears calls from several threads as TBB does; workqueue, which does not, stays the last resort.
os.environ.setdefault("NUMBA_THREADING_LAYER_PRIORITY", "omp tbb workqueue")
# Threads of OpenMP that wait would spin, and take the time of whatever else runs.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")

from nvsf_core.kernels.cache import COMPILED as COMPILED
