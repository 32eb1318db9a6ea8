"""Table 1."""

from studies.accuracy import accuracy_section
from studies.page.model import Table, Text
from tests.studies.accuracy.rows import made_up_rows


def tables(ap40: float | None) -> list[Table]:
    blocks = accuracy_section(made_up_rows(ap40)).blocks
    return [block for block in blocks if isinstance(block, Table)]


def test_the_papers_figures_stand_above_ours() -> None:
    for table, fence in zip(tables(0.5), ("", ", no geofence"), strict=True):
        assert table.rows[0] == (
            f"DBSCAN, Chen et al.{fence}", "merged", "visible", 23.3, 15.2, None, 16.7, 7.8, None,
        )  # fmt: skip
        assert table.rows[1][3:5] == (84.9, 84.8)
        assert [row[:3] for row in table.rows[2:5]] == [
            ("fast", "one scan", "visible"),
            ("fast", "merged", "visible"),
            ("fast", "each scan, then fused", "visible"),
        ]
        assert {row[2] for row in table.rows[5:]} == {"all"}
        assert all(row[3:] == (50.0,) * 6 for row in table.rows[2:])
        assert len(table.rows) == 8


def test_where_nothing_could_be_found_there_is_no_figure() -> None:
    for table in tables(None):
        assert all(row[3:] == (None,) * 6 for row in table.rows[2:])


def test_the_text_says_of_what_the_figures_are() -> None:
    text = accuracy_section(made_up_rows()).blocks[0]
    assert isinstance(text, Text)
    assert "2 samples with 7 scans" in text.text
    assert "CARLA" in text.text


def test_no_sample_makes_a_section_too() -> None:
    assert len(accuracy_section([]).blocks) == 1
