"""The findings of a soak as Markdown."""

from __future__ import annotations

from cpnet.soak.findings import LIMIT_S, Findings, by_victim


def page(findings: Findings, command: str) -> str:
    """Returns a section with tables, and the command that made it."""
    within = sum(f.recovery_s is not None and f.recovery_s <= LIMIT_S for f in findings.faults)
    faults = findings.faults_found()
    lines = [
        f"`{command}`: {findings.minutes:.0f} minutes, {findings.frames} frames, "
        f"{len(findings.faults)} kills, {within} of them right again within {LIMIT_S:g} s.",
        "",
        "| killed | times | median | longest |",
        "|---|---|---|---|",
        *(
            f"| `{name}` | {times} | {mid:.2f} s | {most:.2f} s |"
            for name, times, mid, most in by_victim(findings.faults)
        ),
        "",
        "| resident memory in MiB | first third | last third | most |",
        "|---|---|---|---|",
        *(
            f"| `{g.process}` | {g.early_mib:.0f} | {g.late_mib:.0f} | {g.most_mib:.0f} |"
            for g in findings.memory
        ),
        "",
        f"Unsafe signal states: {len(findings.unsafe)}. The recorder died and noted "
        f"{findings.gaps} gaps; outside of them all requests that were heard are in the database: "
        f"{'yes' if not findings.damage else '; '.join(findings.damage)}.",
    ]
    if faults:
        lines += ["", "Not as it must be:", "", *(f"- {fault}" for fault in faults)]
    return "\n".join(lines) + "\n"
