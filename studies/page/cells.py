"""How a cell of a table is written."""

from __future__ import annotations

from studies.page.model import Cell, Table

DASH = "–"


def written(cell: Cell, form: str) -> str:
    """Returns a cell as text; a form that does not fit leaves it as it is."""
    if cell is None or cell != cell:  # noqa: PLR0124 - NaN, which is no figure either
        return DASH
    if isinstance(cell, str):
        return cell
    try:
        return format(cell, form or ("" if isinstance(cell, int) else ".6g"))
    except ValueError:
        return str(cell)


def rows_of(table: Table) -> list[list[str]]:
    """Returns a table's rows as text."""
    forms = [column.form for column in table.columns]
    return [
        [written(cell, form) for cell, form in zip(row, forms, strict=True)] for row in table.rows
    ]


def numeric(table: Table) -> list[bool]:
    """Tells of each column whether it holds figures: then they stand on the right."""
    return [
        any(row[i] is not None for row in table.rows)
        and not any(isinstance(row[i], str) for row in table.rows)
        for i in range(len(table.columns))
    ]
