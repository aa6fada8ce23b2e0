"""Types of arrays, by their common names."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]
#: Whole numbers of any width; tables and the core say which.
Ints = npt.NDArray[np.signedinteger[Any]]
#: Rows of a table.
Rows = Ints
#: A column of a table, and columns by name.
Column = npt.NDArray[Any]
Columns = dict[str, Column]
