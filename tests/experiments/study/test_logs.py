"""The logs of a study that is started again and again."""

from giril_rl.experiments.study.status import MOST_BYTES, begin_log, last_line


def test_a_log_that_is_too_long_is_put_aside_once(tmp_path):
    log = tmp_path / "logs" / "a.log"
    for number in range(5):
        begin_log(log, ["run", "bc", f"seed={number}"])
        with open(log, "a") as file:
            file.write(f"{number}" * (MOST_BYTES // 2))
    assert sorted(path.name for path in log.parent.iterdir()) == ["a.log", "a.log.old"]
    assert log.read_text() == "\n$ giril run bc seed=4\n" + "4" * (MOST_BYTES // 2)
    old = log.with_name("a.log.old").read_text()
    assert old.startswith("\n$ giril run bc seed=2\n") and old.endswith("3")
    assert len(old) < 2 * MOST_BYTES


def test_the_last_line_of_a_long_log_is_read_from_its_end(tmp_path):
    log = tmp_path / "a.log"
    assert last_line(log) == ""
    log.write_text("first\n" * 100_000 + "the ä last\n\n  \n", encoding="utf-8")
    assert last_line(log) == "the ä last"
    log.write_bytes(b"\xff\xfe only\n")
    assert last_line(log).endswith("only")
