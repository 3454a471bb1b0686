"""The percentile by nearest rank, of the delays of a record and of the values of cases."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def percentile(samples: NDArray[np.float64], percent: float) -> float:
    """The smallest sample that at least `percent` % of the samples do not exceed; NaN without samples."""
    ordered = np.sort(samples)
    if not len(ordered) or np.isnan(ordered[-1]):
        return np.nan
    return float(ordered[max(int(np.ceil(percent / 100.0 * len(ordered) - 1e-9)), 1) - 1])
