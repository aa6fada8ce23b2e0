# Arrays and columns that go in and come out.
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

_Array: TypeAlias = npt.NDArray[Any]
_Floats: TypeAlias = npt.NDArray[np.float64]
_Bytes: TypeAlias = npt.NDArray[np.uint8]
_Columns: TypeAlias = dict[str, Any]  # of arrays; no other mapping will do
