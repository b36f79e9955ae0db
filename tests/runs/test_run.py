import errno
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
import yaml

from giril_rl.errors import UserError
from giril_rl.runs.loggers import check_logger
from giril_rl.runs.metrics import read_metrics
from giril_rl.runs.run import Run

CONFIG = {"seed": 0, "out": "a", "ppo": {"lr": 3e-4, "hidden": [100, 100], "clip": 0.1}}


def test_new_folder_holds_config_and_versions(tmp_path):
    with Run.open(tmp_path / "run", CONFIG, recipe="giril") as run:
        assert run.result is None
        assert run.load("ppo") is None
    saved = yaml.safe_load((tmp_path / "run" / "config.yaml").read_text())
    assert saved == {"recipe": "giril", **CONFIG}
    versions = json.loads((tmp_path / "run" / "versions.json").read_text())
    assert versions["torch"] == str(torch.__version__)
    assert versions["python"].startswith("3.")


def test_metrics_checkpoints_and_result_are_kept(tmp_path):
    with Run.open(tmp_path, CONFIG, recipe="giril") as run:
        run.log(512, {"ppo/loss": torch.tensor(0.5), "train/return_mean": 21}, phase="ppo")
        run.log(1024, {"ppo/loss": float("nan")}, phase="ppo")
        run.save("ppo", {"step": 512, "x": torch.ones(2)})
        # Every line is on disk at once, as strict JSON.
        assert "NaN" not in (tmp_path / "metrics.jsonl").read_text()
    with Run.open(tmp_path, CONFIG, recipe="giril") as run:
        assert run.load("ppo")["x"].tolist() == [1.0, 1.0]
        run.finish({"return_mean": 990.2})
        assert run.result == {"return_mean": 990.2}
    assert read_metrics(tmp_path / "metrics.jsonl") == [
        {"phase": "ppo", "step": 512, "ppo/loss": 0.5, "train/return_mean": 21.0},
        {"phase": "ppo", "step": 1024, "ppo/loss": None},
    ]


def test_truncate_drops_only_later_rows_of_its_phase(tmp_path):
    with Run.open(tmp_path, CONFIG, recipe="giril") as run:
        run.log(9000, {"fit/loss": 1.0}, phase="fit")
        for step in (512, 1024, 1536):
            run.log(step, {"ppo/loss": 1.0}, phase="ppo")
        run.truncate_metrics("ppo", 1024)
        run.log(1536, {"ppo/loss": 2.0}, phase="ppo")
    rows = [(row["phase"], row["step"]) for row in read_metrics(tmp_path / "metrics.jsonl")]
    assert rows == [("fit", 9000), ("ppo", 512), ("ppo", 1024), ("ppo", 1536)]


@pytest.mark.parametrize(
    ("code", "kind"),
    [(errno.ENOENT, UserError), (errno.ENAMETOOLONG, UserError), (errno.EIO, OSError)],
)
def test_a_folder_that_the_system_will_not_make_is_refused(code, kind, tmp_path, monkeypatch):
    """A bad choice of a place is the user's to correct; a disk that fails is told of as such."""

    def refuse(path, *args, **kwargs):
        raise OSError(code, os.strerror(code), str(path))

    monkeypatch.setattr(Path, "mkdir", refuse)
    with pytest.raises(kind, match=os.strerror(code)):
        Run.open(tmp_path / "run", CONFIG, recipe="giril")


def test_half_written_line_does_not_swallow_the_next(tmp_path):
    with Run.open(tmp_path, CONFIG, recipe="giril") as run:
        run.log(1, {"ppo/loss": 1.0}, phase="ppo")
    with open(tmp_path / "metrics.jsonl", "a") as file:
        file.write('{"phase": "ppo", "st')
    with Run.open(tmp_path, CONFIG, recipe="giril") as run:
        run.log(2, {"ppo/loss": 1.0}, phase="ppo")
    lines = (tmp_path / "metrics.jsonl").read_text().splitlines()
    assert [json.loads(line)["step"] for line in lines] == [1, 2]


def test_other_settings_are_named_and_ignored_ones_are_not(tmp_path):
    with Run.open(tmp_path, CONFIG, recipe="giril"):
        pass
    with Run.open(tmp_path, {**CONFIG, "out": "b", "threads": 4}, recipe="giril"):
        pass
    other = {"seed": 1, "out": "a", "ppo": {"lr": 3e-4, "hidden": [64], "entropy": 0.0}}
    with pytest.raises(UserError) as raised:
        Run.open(tmp_path, other, recipe="gail")
    message = str(raised.value)
    assert "recipe: giril there, gail now; seed: 0 there, 1 now; ppo.hidden: [100, 100]" in message
    assert "and 2 more" in message  # ppo.entropy and ppo.clip
    assert "choose another out=, or delete the folder" in message
    # The refusal let go of the lock, and left the folder as it was.
    with Run.open(tmp_path, CONFIG, recipe="giril"):
        pass


def test_ignore_covers_what_is_below_a_key(tmp_path):
    with Run.open(tmp_path, CONFIG, recipe="giril"):
        pass
    changed = {**CONFIG, "ppo": {"lr": 1.0}}
    with Run.open(tmp_path, changed, recipe="giril", ignore={"ppo"}):
        pass


def test_foreign_folder_is_refused_and_untouched(tmp_path):
    (tmp_path / "thesis.tex").write_text("years of work")
    with pytest.raises(UserError, match=r"not a run's folder.*thesis\.tex"):
        Run.open(tmp_path, CONFIG, recipe="giril")
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]
    with pytest.raises(UserError, match="is a file"):
        Run.open(tmp_path / "thesis.tex", CONFIG, recipe="giril")


def test_leftovers_of_a_kill_are_no_foreign_files(tmp_path):
    (tmp_path / ".lock").touch()
    (tmp_path / ".config.yaml.12.tmp").write_text("half")
    with Run.open(tmp_path, CONFIG, recipe="giril"):
        assert not (tmp_path / ".config.yaml.12.tmp").exists()


def test_folder_is_held_by_one_at_a_time(tmp_path):
    code = (
        "import sys\nfrom giril_rl.runs.run import Run\nfrom giril_rl.errors import UserError\n"
        "try:\n    Run.open(sys.argv[1], {}, recipe='x')\nexcept UserError as e:\n    print(e)"
    )
    with Run.open(tmp_path, {}, recipe="x"):
        with pytest.raises(UserError, match="in use"):
            Run.open(tmp_path, {}, recipe="x")
        done = subprocess.run(
            [sys.executable, "-c", code, str(tmp_path)], capture_output=True, text=True, check=True
        )
        assert "is in use by another process" in done.stdout
    with Run.open(tmp_path, {}, recipe="x"):
        pass


def test_changed_versions_are_a_warning(tmp_path):
    with Run.open(tmp_path, {}, recipe="x"):
        pass
    versions = json.loads((tmp_path / "versions.json").read_text())
    (tmp_path / "versions.json").write_text(json.dumps({**versions, "torch": "1.0"}))
    with (
        pytest.warns(UserWarning, match=r"begun with torch 1\.0"),
        Run.open(tmp_path, {}, recipe="x"),
    ):
        pass


def test_csv_and_tensorboard_loggers_write_into_the_folder(tmp_path):
    with Run.open(tmp_path / "a", {}, recipe="x", logger="csv") as run:
        run.log(512, {"ppo/loss": 0.5}, phase="ppo")
    assert (tmp_path / "a/csv/scalars/ppo/loss.csv").read_text() == "512,0.5\n"
    with Run.open(tmp_path / "b", {}, recipe="x", logger="tensorboard") as run:
        run.log(512, {"ppo/loss": 0.5}, phase="ppo")
    assert list((tmp_path / "b/tensorboard").glob("events.*"))


def test_missing_and_unknown_loggers_are_named(tmp_path, monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(UserError, match=r'pip install "giril-rl\[loggers\]"'):
        Run.open(tmp_path / "run", {}, recipe="x", logger="wandb")
    assert not (tmp_path / "run").exists()
    check_logger("csv")
    with pytest.raises(UserError, match="unknown"):
        check_logger("printer")


def test_a_refused_run_leaves_no_folder(tmp_path):
    place = tmp_path / "runs" / "giril" / "seed0"
    with pytest.raises(UserError), Run.open(place, CONFIG, recipe="giril"):
        raise UserError("the demonstration is empty: record a longer one.")
    assert list(tmp_path.iterdir()) == []
    # A folder that was there stays, as it was.
    place.mkdir(parents=True)
    with pytest.raises(UserError), Run.open(place, CONFIG, recipe="giril"):
        raise UserError("the demonstration is empty: record a longer one.")
    assert list(place.iterdir()) == []


@pytest.mark.parametrize("part", ["metrics", "checkpoint", "bug"])
def test_a_run_of_which_something_came_keeps_its_folder(part, tmp_path):
    error = ValueError if part == "bug" else UserError
    with pytest.raises(error), Run.open(tmp_path / "run", CONFIG, recipe="giril") as run:
        if part == "metrics":
            run.log(1, {"loss": 1.0}, phase="fit")
        if part == "checkpoint":
            run.save("fit", {"step": 1})
        raise error("stopped")
    with pytest.raises(UserError), Run.open(tmp_path / "run", CONFIG, recipe="giril"):
        raise UserError("refused when it continues")
    assert (tmp_path / "run" / "config.yaml").exists()


def test_what_a_run_has_opened_is_closed_with_it(tmp_path):
    class Simulator:
        closed = 0

        def close(self):
            self.closed += 1

    with pytest.raises(RuntimeError), Run.open(tmp_path / "run", {}, recipe="x") as run:
        simulator = run.closing(Simulator())
        raise RuntimeError
    assert simulator.closed == 1
