"""A series as it was fitted, frame by frame."""

import dataclasses
from .result import FitResult

@dataclasses.dataclass(frozen=True)
class SeriesFit:
    result: FitResult
    names: tuple[str, ...]
