"""What is in the folders of runs: whether it can be read, and what of it must repeat."""

import json
from pathlib import Path

import torch
import yaml

from giril_rl.demos import Demonstration
from giril_rl.files.disk import read_json
from giril_rl.runs.checkpoint import load_state
from giril_rl.runs.metrics import read_metrics

CLOCK = {"wall_seconds", "fit_seconds", "steps_per_second", "finished_at", "seconds"}
PLACE = {"out", "root"}
PNG_END = b"IEND\xaeB`\x82"


def files(root):
    """All files below ``root`` but locks and a logger's own, by their path."""
    found = (path for path in sorted(Path(root).rglob("*")) if path.is_file())
    return {
        str(path.relative_to(root)): path
        for path in found
        # A logger has shown what it has shown; only the run's own files are put right.
        if path.suffix != ".lock" and not {"csv", "tensorboard"} & set(path.parts)
    }


def read(path):
    """A file as values that can be compared, without what a clock or a place says.

    Raises:
        Exception: whatever the reader says of a file that is not whole.
    """
    if path.suffix == ".safetensors":
        return bits({k: v for k, v in load_state(path).items() if k not in CLOCK})
    if path.suffix == ".json" and "transitions" not in path.parts:
        return {k: v for k, v in read_json(path).items() if k not in CLOCK}
    if path.suffix == ".yaml":
        settings = yaml.safe_load(path.read_text())
        return {k: v for k, v in settings.items() if k not in PLACE}
    if path.name == "metrics.jsonl":
        rows = read_metrics(path)
        return [{k: v for k, v in row.items() if "seconds" not in k} for row in rows]
    content = path.read_bytes()
    if path.suffix == ".png":
        assert content.endswith(PNG_END), path
    return content


def bits(value):
    """Nested state with each tensor as its type, shape and bytes."""
    if isinstance(value, torch.Tensor):
        flat = value.contiguous().reshape(-1).view(torch.uint8).numpy().tobytes()
        return str(value.dtype), tuple(value.shape), flat
    if isinstance(value, dict):
        return {key: bits(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [bits(entry) for entry in value]
    return value


def contents(root):
    """Everything below ``root``, as :func:`read` gives it."""
    return {name: read(path) for name, path in files(root).items()}


def assert_readable(root):
    """Nothing below ``root`` is half of something, except files that say so by their name."""
    for name, path in files(root).items():
        if any(part.startswith(".") and part.endswith(".tmp") for part in Path(name).parts):
            continue
        read(path)
        if path.name == "metrics.jsonl":
            lines = path.read_text().split("\n")
            assert all(json.loads(line) for line in lines[:-1]), name
        if path.name == "card.json" and "demos" in path.parts:
            Demonstration.load(path.parent)


def assert_same(found, expected, note=""):
    """Two :func:`contents`; names what differs rather than showing megabytes."""
    assert sorted(found) == sorted(expected), note
    different = [name for name in expected if found[name] != expected[name]]
    assert not different, (note, different)
