"""``giril demo show``, on demonstrations of vectors and of images."""

import sys
from pathlib import Path

import pytest
import torch
from PIL import Image

sys.path.insert(0, str(Path(__file__).parents[1] / "demos"))

from counter import Counter
from pixels import Pixels, steer

from giril_rl.cli.command_line import main
from giril_rl.demos import record_demonstration
from giril_rl.runs.machine import processor


@pytest.fixture
def images(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    demo = record_demonstration(
        Pixels,
        steer,
        length=8,
        seed=0,
        task="pixels",
        expert={"return_mean": 1234.5, "seed": 2},
        lives="first",
    )
    demo.save("images")
    return demo


@pytest.fixture
def vectors(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    record_demonstration(
        Counter, lambda o: o[:, 1:] * 0.25, episodes=1, seed=3, task="counter", deterministic=False
    ).save("vectors")


def shown(capsys, *argv):
    assert main(["demo", "show", *argv]) == 0
    return capsys.readouterr().out.splitlines()


def test_images_are_described(images, capsys):
    counts = torch.bincount(images.transitions["action"], minlength=3).tolist()
    names = ("NOOP", "LEFT", "RIGHT")
    parts = [f"{a}: {n} ({n / 8:.0%})" for a, n in zip(names, counts, strict=True) if n]
    scores = [f"{score:.1f}" for score in images.returns.tolist()]
    assert shown(capsys, "images") == [
        "task         pixels (None)",
        f"id           {images.demo_id}",
        "transitions  8",
        "episodes     3, each up to the first lost life",
        "observation  images 3 x 5 x 4",
        f"actions      {', '.join(parts)}",
        "played       deterministic, seed 0",
        "expert       return 1,234.5, seed 2",
        f"processor    {processor()}",
        "",
        "episode  length  score  end",
        f"      0       3    {scores[0]}  life lost",
        f"      1       3    {scores[1]}  life lost",
        f"      2       2    {scores[2]}  cut",
    ]
    assert [path.name for path in Path().iterdir()] == ["images"]


def test_vectors_are_described(vectors, capsys):
    assert shown(capsys, "vectors")[4:] == [
        "observation  2 numbers",
        "actions      1 number from 0.00 to 1.00",
        "played       sampled, seed 3",
        "expert       not known",
        f"processor    {processor()}",
        "",
        "episode  length  score  end",
        "      0       5    5.0  terminated",
    ]


def test_every_frame_is_in_the_gif_at_its_speed(images, capsys):
    shown(capsys, "images", "--out", "game.gif", "--fps", "10")
    data, last = images.transitions, (images.lengths.cumsum(0) - 1).tolist()
    with Image.open("game.gif") as picture:
        assert (picture.size, picture.info["loop"]) == ((16, 20), 0)
        frames, duration = [], 0
        for index in range(picture.n_frames):
            picture.seek(index)
            duration += picture.info["duration"]
            pixels = torch.tensor(list(picture.convert("L").tobytes()), dtype=torch.uint8)
            frames.append(pixels.reshape(20, 16)[::4, ::4])
    assert duration == 100 * (8 + 3)
    expected = []
    for row in range(8):
        if data["step"][row] == 0:
            expected.append(data["observation"][row, -1])
        expected.append(data["next", "observation"][row, -1])
    assert last == [2, 5, 7]
    assert torch.stack(frames).equal(torch.stack(expected))


def test_a_gif_is_replaced(images, capsys):
    Path("game.gif").write_text("old")
    shown(capsys, "images", "--out", "game.gif")
    assert Path("game.gif").read_bytes().startswith(b"GIF89a")


def test_vectors_have_no_picture(vectors, refused):
    sentence = refused("demo", "show", "vectors", "--out", "a.gif")
    assert sentence == (
        "--out a.gif: this demonstration's observations are vectors, of which there is no picture."
    )
    assert not Path("a.gif").exists()


@pytest.mark.parametrize(
    ("argv", "sentence"),
    [
        (
            [],
            "the following arguments are required: show|import|export|play; see "
            "`giril demo --help`.",
        ),
        (["show"], "the following arguments are required: PATH; see `giril demo show --help`."),
        (
            ["show", "nowhere"],
            "nowhere is not the folder of a demonstration: recipes keep theirs in "
            "runs/demos/TASK/HASH.",
        ),
        (["show", "images", "--fps", "0"], "--fps 0: from 1 to 50 is possible."),
        (["show", "images", "--fps", "51"], "--fps 51: from 1 to 50 is possible."),
        (
            ["show", "images", "--out", "a.mp4"],
            "--out a.mp4 does not end in .gif: frames are written as a GIF.",
        ),
        (
            ["show", "images", "--out", "no/a.gif"],
            "no/a.gif cannot be written: there is no folder no.",
        ),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_refusals(argv, sentence, images, refused):
    assert refused("demo", *argv) == sentence


def test_a_run_is_not_a_demonstration(images, refused):
    Path("run").mkdir()
    Path("run/result.json").write_text("{}")
    assert "recipes keep theirs in" in refused("demo", "show", "run")


def test_a_damaged_demonstration_is_refused(images, refused):
    Path("images/frames.npz").write_bytes(b"PK")
    assert "frames.npz is damaged" in refused("demo", "show", "images")


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        ([], ["show", "import", "export", "play", "Print what a demonstration holds."]),
        (["show"], ["PATH", "FILE.gif"]),
        (["import"], ["SOURCE", "minari:NAME", "--task", "--env-id", "--out", "--episodes"]),
        (["export"], ["FOLDER", "--minari", "--npz"]),
        (["play"], ["--task", "--lives", "--seed"]),
    ],
)
def test_help(argv, words, capsys):
    with pytest.raises(SystemExit) as leaving:
        main(["demo", *argv, "--help"])
    assert leaving.value.code == 0
    page = capsys.readouterr().out
    assert all(word in page for word in words)
