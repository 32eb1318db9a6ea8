"""Reader of tables in the Feather file format, as Argoverse 2 uses it."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from protocol.extras import to_install


def read_feather(data: bytes) -> dict[str, npt.NDArray[np.generic]]:
    """Returns the columns of numbers by name (N,); others are left out.

    Raises:
        ValueError: it is no such table, or a number is missing.
    """
    try:
        import pyarrow as pa
    except ImportError:
        raise ValueError(
            f"to read .feather needs pyarrow (extra `view`): {to_install('view')}"
        ) from None
    try:
        table = pa.ipc.open_file(pa.py_buffer(data)).read_all()
        table.validate(full=True)
        kinds = pa.types
        names = [
            field.name
            for field in table.schema
            if kinds.is_integer(field.type) or kinds.is_floating(field.type)
        ]
        columns = {name: table[name].to_numpy() for name in names}
    except (pa.ArrowException, OSError, KeyError, ValueError) as error:
        raise ValueError(f"is no table of Feather: {error!s:.200}") from None
    if empty := [name for name in names if table[name].null_count]:
        raise ValueError(f"lacks numbers in the column {empty[0]}")
    return columns
