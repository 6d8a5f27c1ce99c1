"""Functions that CasADi generated, bound to arrays (module.cpp)."""

import numpy as np
from numpy.typing import NDArray

Shape = tuple[str, int, int]

def shapes(library: str, name: str) -> tuple[list[Shape], list[Shape]]: ...

class Bound:
    def __init__(
        self,
        library: str,
        name: str,
        inputs: list[NDArray[np.float64]],
        outputs: list[NDArray[np.float64]],
    ) -> None: ...
    def run(self) -> None: ...
