"""Counts the cases in which a driver met a fault of its device."""

COUNTED = "tests/faults/"
WANTED = 120


def pytest_terminal_summary(terminalreporter):
    """Print how many cases of driver × fault were run in this session, and how many of them passed."""
    reports = {how: terminalreporter.stats.get(how, []) for how in ("passed", "failed")}
    ours = {how: {report.nodeid for report in found if COUNTED in report.nodeid} for how, found in reports.items()}
    total = len(ours["passed"] | ours["failed"])
    if total:
        terminalreporter.write_line(f"driver x fault: {total} cases, {len(ours['passed'])} passed (wanted: {WANTED})")
