import io

from giril_rl.runs.progress import progress


def test_short_work_without_a_terminal_is_silent():
    log = io.StringIO()
    with progress(10, desc="fit", stream=log) as bar:
        bar.update(10)
    assert log.getvalue() == ""


def test_lines_without_a_terminal_are_whole_and_count_from_the_start(monkeypatch):
    now = [0.0]
    monkeypatch.setattr("tqdm.std.time", lambda: now[0])
    log = io.StringIO()
    with progress(4000, 1000, "policy", stream=log) as bar:
        for _ in range(30):
            now[0] += 2.0
            bar.update(100)
    lines = log.getvalue().splitlines()
    assert len(lines) == 2  # at 30 s and 60 s
    assert "\r" not in log.getvalue()
    assert "2500/4000 [00:30<00:30, 50.00 steps/s]" in lines[0]
    assert "4000/4000" in lines[1]


def test_terminal_gets_a_bar():
    class Terminal(io.StringIO):
        def isatty(self):
            return True

    log = Terminal()
    with progress(10, desc="fit", stream=log) as bar:
        bar.update(10, loss=0.5)
    assert "10/10" in log.getvalue()
    assert "loss=0.5" in log.getvalue()
