"""The estimate of a bar, with a clock of the test's own."""

from io import StringIO

import pytest

from igps._progress import Progress


class Terminal(StringIO):
    def isatty(self):
        return True


@pytest.fixture
def clock(monkeypatch):
    """The time in seconds that bars see."""
    now = [0.0]
    monkeypatch.setattr("tqdm.std.time", lambda: now[0])
    return now


def test_the_first_result_does_not_count_in_the_estimate(clock):
    """Loops are compiled for 30 seconds, then each body takes 2: of 10 bodies, 7 are left after 34 seconds."""
    text = Terminal()
    with Progress(total=10, desc="bodies", file=text) as bar:
        for seconds in (30, 32, 34):
            clock[0] = seconds
            bar.update()
        assert bar.format_dict["n"] == 3
        assert "2.00s/it" in str(bar)
        assert "<00:14" in str(bar)
    assert "the first takes longer" in text.getvalue()


def test_a_bar_without_progress_prints_nothing():
    text = StringIO()
    with Progress(total=2, disable=True, file=text) as bar:
        bar.update()
    assert text.getvalue() == ""


def test_in_a_file_a_warning_is_a_line_and_does_not_repeat_the_bar():
    text = StringIO()
    with Progress(total=2, desc="bodies", file=text) as bar:
        for _ in range(2):
            Progress.write("WARNING: skipped", file=text)
            bar.update()
    warnings = ["WARNING: skipped"] * 2
    assert text.getvalue().splitlines() == [*warnings, "bodies: 2/2 [00:00<00:00]"]


def test_in_a_file_a_bar_is_a_line_a_minute_and_one_at_its_end(clock):
    text = StringIO()
    with Progress(total=10, desc="bodies", file=text) as bar:
        for seconds in range(0, 190, 19):
            clock[0] = seconds
            bar.update()
    assert text.getvalue().splitlines() == [
        "bodies: 5/10 [01:16<01:35]",
        "bodies: 9/10 [02:32<00:19]",
        "bodies: 10/10 [02:51<00:00]",
    ]
