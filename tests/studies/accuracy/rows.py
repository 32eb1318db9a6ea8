"""Rows as an evaluation makes them, without one."""

from studies.evaluate import ALL, IOUS, KINDS, TRUTHS, VIEWS, EvalRow


def made_up_rows(ap40: float | None = 0.5) -> list[EvalRow]:
    """A detector's rows, all parts together."""
    return [
        EvalRow(
            "fast", *kind, truth, geofence, view, iou, ALL.name,
            scenes=7 if kind[0] == "single" else 2, vehicles=9, ap40=ap40, recall=ap40,
            precision=None, detect_ms=1.5,
        )
        for geofence in (True, False)
        for kind in KINDS
        for truth in TRUTHS
        for view in VIEWS
        for iou in IOUS
    ]  # fmt: skip
