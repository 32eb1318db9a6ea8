"""Array fields of messages: dtype and shape are declared once and checked on both sides."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt
from pydantic import GetCoreSchemaHandler
from pydantic_core import CoreSchema, core_schema


@dataclass(frozen=True, slots=True)
class Array:
    """Declares a field's dtype and shape; None is a free dimension."""

    dtype: str
    shape: tuple[int | None, ...]

    def check(self, value: Any) -> npt.NDArray[Any]:  # noqa: ANN401 - pydantic hands over anything
        """Returns the value as a contiguous read-only array.

        Raises:
            ValueError: wrong dtype kind, wrong shape or a non-finite number.
        """
        array = np.ascontiguousarray(value, np.dtype(self.dtype))
        self.check_shape(array.shape)
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            raise ValueError(f"{np.count_nonzero(~np.isfinite(array))} numbers are not finite")
        if array.flags.writeable:
            array = array.view()
            array.setflags(write=False)
        return array

    def check_shape(self, shape: tuple[int, ...]) -> None:
        """Raises ValueError unless the shape is one that was declared."""
        fits = len(shape) == len(self.shape) and all(
            want is None or want == got for want, got in zip(self.shape, shape, strict=True)
        )
        if not fits:
            raise ValueError(f"array has shape {shape}, declared {self.shape}")

    def size_bytes(self, shape: tuple[int, ...]) -> int:
        """Returns how many bytes an array of this shape takes, in exact integers."""
        count = np.dtype(self.dtype).itemsize
        for side in shape:
            count *= side
        return count

    def __get_pydantic_core_schema__(
        self, source: type, handler: GetCoreSchemaHandler
    ) -> CoreSchema:
        return core_schema.no_info_plain_validator_function(self.check)


PoseRows = Annotated[npt.NDArray[np.float64], Array("<f8", (None, 6))]
PoseRow = Annotated[npt.NDArray[np.float64], Array("<f8", (6,))]
SiteRows = Annotated[npt.NDArray[np.float64], Array("<f8", (None, 2))]
WeightRows = Annotated[npt.NDArray[np.float64], Array("<f8", (None, 3))]
BoxRows = Annotated[npt.NDArray[np.float32], Array("<f4", (None, 7))]
Floats32 = Annotated[npt.NDArray[np.float32], Array("<f4", (None,))]
Bytes = Annotated[npt.NDArray[np.uint8], Array("|u1", (None,))]
Indices = Annotated[npt.NDArray[np.int32], Array("<i4", (None,))]
Vertices = Annotated[npt.NDArray[np.float32], Array("<f4", (None, 3))]
Triangles = Annotated[npt.NDArray[np.int32], Array("<i4", (None, 3))]
